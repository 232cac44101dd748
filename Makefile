PY ?= python3

.PHONY: demo test check

demo test check:
	$(PY) tools/bootstrap.py $@
