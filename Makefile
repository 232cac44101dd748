PY ?= python3

.PHONY: demo test test-all check

demo test test-all check:
	$(PY) tools/bootstrap.py $@
