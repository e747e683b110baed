# Two commands set everything up on a fresh machine: `make demo` and `make test`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-long test-all lint check lowest audit release docs install clean

demo: $(VENV)/.base
	$(BIN)/lidarslam demo

# A file's tests stay together, so that their fixtures are made once; single-threaded, as there is a process a core.
PYTEST := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/pytest -n auto --dist loadfile

test: install
	@echo "running the tests: about 5 minutes on two cores"
	$(PYTEST)

# Those that take more than a few seconds.
test-long: install
	@echo "running the long tests: about 8 minutes on two cores"
	$(PYTEST) -m "long and not slow"

# All of them, the slow ones on recordings where they are at hand.
test-all: install
	@echo "running all tests: about 40 minutes on two cores"
	$(PYTEST) -m "slow or not slow"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# Before a commit; continuous integration runs the long tests, too.
check: lint
	$(PYTEST)

# The lowest versions of libraries that pyproject.toml allows, which needs the network.
lowest:
	PYTHON=$(PYTHON) sh scripts/lowest_versions.sh

# Known vulnerabilities of the installed libraries; asks the databases on the network.
audit: install
	$(BIN)/python -m pip install --quiet pip-audit
	$(BIN)/pip-audit --skip-editable

# Source distribution and wheel in dist/, once the wheel has been tried in an environment of its own; publishes nothing.
release:
	sh scripts/system_libraries.sh
	PYTHON=$(PYTHON) sh scripts/release.sh

# The documentation as a site; warnings are errors (mkdocs.yml), which --quiet would hide.
docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "written to build/site; open build/site/index.html"

install: $(VENV)/.installed

# What users install: no PyTorch.
$(VENV)/.base: pyproject.toml constraints.txt scripts/system_libraries.sh
	@echo "installing lidarslam and its libraries (2 GB) into $(VENV), once: a few minutes, in which pip is silent"
	sh scripts/system_libraries.sh
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed: $(VENV)/.base
	@echo "installing PyTorch (1 GB, with CUDA several), once: a few minutes"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	@echo "installing the libraries of the tests, once: a few minutes"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@echo "compiling loops, once"
	$(BIN)/python -m lidarslam.pipeline.compile_ahead
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
