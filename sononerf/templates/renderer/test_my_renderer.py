from sononerf import testing


def test_it_holds_what_renderers_promise():
    testing.check_renderer("my_renderer")
