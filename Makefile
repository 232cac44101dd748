PY ?= python3

.PHONY: demo test test-all check docs

demo test test-all check docs:
	$(PY) tools/bootstrap.py $@
