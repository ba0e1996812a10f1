# `make demo` and `make test` do everything on a fresh machine; the first of them prepares the environment.

VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# An interpreter is asked for its version: some machines have launchers for versions they do not run.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info[:2] not in {(3, 11), (3, 12), (3, 13)})' 2>/dev/null \
	&& command -v "$$p" && break; done)

# Extra wheel index for torch alone, such as PyTorch's CPU index: make demo TORCH_INDEX=URL.
TORCH_INDEX ?=
# Processes of the tests; each of them compiles and simulates, so more than cores only slows down.
TEST_JOBS ?= 2
# Folder of OBJ, STL, PLY or GLB files for the demo: make demo MESHES=DIR.
MESHES ?=
DEMO_ARGS ?=
TEST_ARGS ?=
BENCH_ARGS ?=
# Suites of published figures, all by default, and their objects: make figures FIGURES=teacher OBJECTS="held-out=TEST validation=VALIDATION".
FIGURES ?=
OBJECTS ?=
FIGURES_ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help env demo test coverage lint type format reference docs bench figures clean

help:
	@echo 'make demo     turn unseen objects, close a gap, drive a simulated hand, train a little: demo/index.html'
	@echo '              MESHES=DIR turns your own meshes; DEMO_ARGS=--quick ends after the first part'
	@echo 'make test     all tests; TEST_ARGS="-k rewards" chooses some'
	@echo 'make coverage  the same, and which lines no test runs'
	@echo 'make lint     ruff, without changing files      make format   the same, changing files'
	@echo 'make type     mypy on the package               make bench    simulation throughput'
	@echo 'make docs     the documentation as a site, build/site/index.html'
	@echo 'make figures  every published figure anew, hours on a GPU; FIGURES=teacher some, OBJECTS="held-out=DIR ..."'
	@echo 'make reference  the tables of docs/reference, from the code'
	@echo 'make env      only the environment (.venv)      make clean    remove build products'
	@echo 'TORCH_INDEX=URL takes torch from another wheel index, such as its CPU-only one'

env: $(STAMP)

# torch comes first: where no GPU is found, its size is worth a word before the download starts.
$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { \
	  echo 'No Python 3.11, 3.12 or 3.13 found (3.14 lacks newton-usd-schemas). Install one (Debian, Ubuntu: apt install python3.11 python3.11-venv;' >&2; \
	  echo 'elsewhere: pyenv install 3.11) or name it: make PYTHON=/path/to/python3.11' >&2; exit 1; }
	@test -n "$(TORCH_INDEX)" || command -v nvidia-smi >/dev/null || \
	  echo 'No GPU found. If pip chooses the CUDA build of torch below (gigabytes), stop it and set TORCH_INDEX, see docs/install.md.'
	test -x $(BIN)/pip || "$(PYTHON)" -m venv --clear $(VENV)
	$(BIN)/pip install -c constraints.txt setuptools
	$(BIN)/pip install -c constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch
	$(BIN)/pip install -c constraints.txt --no-build-isolation -e '.[dev]'
	@touch $(STAMP)

demo: $(STAMP)
	$(BIN)/python -m vd.train.demo $(if $(MESHES),--meshes "$(MESHES)") $(DEMO_ARGS)

# A file's tests stay in one process: its fixtures build simulators, which is what takes the time.
# Files keep the order of tests/conftest.py, which puts slow ones first.
test: $(STAMP)
	@echo 'all tests take about ten minutes on two cores; each file is named as it begins'
	$(BIN)/python -m pytest -n $(TEST_JOBS) --dist loadfile --no-loadscope-reorder $(TEST_ARGS)

# Code in Warp kernels and in processes of their own is not counted.
coverage: $(STAMP)
	$(MAKE) --no-print-directory test TEST_ARGS='--cov=vd --cov-report=term:skip-covered $(TEST_ARGS)'

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The folders become one package only when installed; links show the checker that package.
type: $(STAMP)
	rm -rf build/types/vd && mkdir -p build/types/vd
	cd build/types/vd && ln -s $(wildcard $(CURDIR)/vd/*) $(addprefix $(CURDIR)/,kernels assets_usd train deploy) .
	cd build/types && "$(abspath $(BIN))/mypy" --config-file ../../pyproject.toml -p vd

# Strict: a broken link or anchor, or a page that is nowhere listed, fails.
reference: $(STAMP)
	$(BIN)/python docs/site_pages.py

docs: $(STAMP)
	test -x $(BIN)/mkdocs || $(BIN)/pip install -c constraints.txt --no-build-isolation -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(STAMP)
	$(BIN)/vd-bench sim $(BENCH_ARGS)

# What this code has measured is not measured again, and is taken whatever else fails.
# FIGURES_ARGS="--jobs 8" spreads it over the GPUs.
figures: $(STAMP)
	$(BIN)/python docs/figures.py run $(FIGURES) --objects $(OBJECTS) $(FIGURES_ARGS); status=$$?; \
	$(BIN)/python docs/figures.py collect $(FIGURES) && exit $$status

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
