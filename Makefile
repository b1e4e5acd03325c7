# Every target sets itself up: `make demo` is all a fresh machine with Python 3.11 and make needs.
PYTHON ?= python3
OUT ?= out
BIN := .venv/bin
DEMO := .venv/.ready-demo
READY := .venv/.ready
# Real samples for the tests that need them; those tests skip, and say so, where there are none.
export DEPTHPOSE_DATA ?= $(wildcard $(CURDIR)/../shared/data)

# Tests side by side, one thread each: threads of torch in every worker would fight for cores. Who
# has none left takes some of another's; the slow ones share what a file sets up, and stay together.
# Bytecode is kept even where containers say otherwise: a worker rewrites 300 files of tests for 12 s
# of a core, and every program that a test starts would compile the package again.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest \
	--numprocesses auto --maxprocesses 8
# Shapes and types of every call, checked while tests run: slower, so only with TYPES=1, as .ci/run
# has it for the quick tests. Most slow ones start commands, and in those processes nothing is checked.
TYPES ?=
CHECKED := --jaxtyping-packages=depthpose,tests.typecheck.check

.PHONY: all setup demo test test-slow check docs bench clean
all: check test

setup: $(READY)

# torch first and exactly, so that nothing else chooses a build of several gigabytes.
$(DEMO): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "torch into .venv. On Linux this is a GPU build of several GB; for the CPU"
	@echo "   build (0.9 GB): PIP_EXTRA_INDEX_URL=URL make ..., URL as PyTorch's 'Start Locally' page says."
	$(BIN)/python -m pip install -c constraints.txt torch==$$(sed -n 's/^torch==//p' constraints.txt)
	@echo "depthpose and what its demo needs"
	$(BIN)/python -m pip install -c constraints.txt -e '.[demo]'
	touch $@
	@echo "ready: 'source .venv/bin/activate' puts depthpose on your path"

$(READY): $(DEMO)
	@echo "what the tests and checks need"
	$(BIN)/python -m pip install -c constraints.txt -e '.[dev]'
	touch $@

demo: $(DEMO)
	$(BIN)/depthpose demo --out $(OUT)/demo

test: $(READY)
	$(PYTEST) --dist worksteal $(if $(TYPES),$(CHECKED))

test-slow: $(READY)
	$(PYTEST) --dist loadfile $(if $(TYPES),$(CHECKED)) -m slow

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

# A dead link or a name that nobody documents fails it.
docs: $(READY)
	$(BIN)/sphinx-build -q -W --keep-going docs $(OUT)/docs
	@echo "the pages: $(OUT)/docs/index.html"

bench: $(READY)
	$(BIN)/python bench/startup.py
	$(BIN)/python bench/stereo_speed.py
	$(BIN)/python bench/stereo_memory.py
	$(BIN)/python bench/mono_speed.py
	$(BIN)/depthpose data make streets --out $(OUT)/bench/streets --number 20 --scale 0.5 --no-with-lidar
	$(BIN)/python bench/training_speed.py --data $(OUT)/bench/streets
	$(BIN)/python bench/voting_speed.py
	$(BIN)/python bench/sparse_speed.py

clean:
	rm -rf .venv $(OUT) .pytest_cache .ruff_cache .hypothesis .import_linter_cache
