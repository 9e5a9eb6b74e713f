# `make demo` and `make test` need only make and Python 3.11+; everything else is installed into .venv
# once, and again only when pyproject.toml or constraints.txt change.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := hardware,viz,train,docs,dev

.PHONY: help demo test test-slow lint docs format clean

help:
	@echo "make demo       plan and execute the example poses, draw them into out/demo"
	@echo "make test       lint, type check, the documentation's build and the default tests"
	@echo "make test-slow  the long tests alone"
	@echo "make lint       ruff and mypy alone"
	@echo "make docs       the documentation as a site, in out/site"
	@echo "make clean      remove .venv and out"

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "muxjax needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

demo: $(STAMP)
	$(BIN)/muxjax demo

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Strict: a page that is not in the navigation, a dead link or a wrong docstring is an error.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

test: lint docs
	$(BIN)/python -m pytest -m "not slow" -n auto --dist worksteal

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow -n auto --dist worksteal

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) out
