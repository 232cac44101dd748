PY ?= python3
BIN = .venv/bin/
PIP = $(BIN)python -m pip install --quiet --quiet --disable-pip-version-check --no-compile
TORCH = $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch==2.13.0

.PHONY: demo test check docs
demo: .venv/demo ; $(BIN)sononerf fit configs/three_spheres.yaml --output runs/demo $(ARGS)
test: .venv/test ; $(BIN)ruff check --quiet . && $(BIN)python -m pytest -n auto --maxprocesses 4 --dist loadfile $(ARGS)
check: .venv/test ; $(BIN)ruff check . && $(BIN)ruff format --check . && $(BIN)mypy
docs: .venv/test ; $(BIN)python -m sphinx -W --keep-going -q docs docs/_build $(ARGS)
.venv/demo .venv/test: pyproject.toml
	@echo "installing into .venv (about a minute the first time)"
	test -x $(BIN)python || $(PY) -m venv .venv
	$(PIP) $(TORCH) && $(PIP) --editable '.$(if $(filter %test,$@),[test])'
	touch $@
