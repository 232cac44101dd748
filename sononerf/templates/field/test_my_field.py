from sononerf import testing


def test_it_holds_what_fields_promise():
    testing.check_field("my_field", width=16)
