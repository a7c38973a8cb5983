# make demo and make test set up .venv by themselves; only Python 3.11 or newer is needed.
# make docs renders the pages' tables from the stored results, and builds the site in site/.
# make docs-claims FUSELOG_DATA=FOLDER runs the experiments first: all, or those listed in NAMES="...".
PYTHON ?= $(shell command -v python3.11 || command -v python3 || command -v python)
BIN := .venv/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# --no-compile: Python compiles modules when they are imported, and most are not imported
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# commands are started some hundred times: cache the bytecode of their imports, even if the user's settings do not
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-fast all-tests fast-tests coverage lint wheel mutants bench deployed faults docs docs-claims keep-numbers format clean

demo: .venv/with-fuselog
	$(BIN)/fuselog run landmarks --runs 20 --out demo/landmarks
	$(BIN)/fuselog report demo/landmarks --out demo/report.html
	@echo
	@echo "Scrub the timeline:  $(BIN)/fuselog view demo/landmarks"
	@echo "Read the report:     demo/report.html (open it in a browser)"
	@echo "Summary figure:      demo/landmarks/figures/errors-robot1.svg"
	@echo "Logs and estimates:  demo/landmarks/logs, demo/landmarks/estimates (MCAP)"
	@echo "Tables and numbers:  demo/landmarks/tables, demo/landmarks/result.json"

# all tests and the linters, in parallel. There is one process per core. Each test file stays in one process, so that its
# fixtures are created once. Kernels are cached on disk, and compiled by the first process that needs them
test: .venv/with-test
	$(MAKE) -j2 all-tests lint

test-fast: .venv/with-test
	$(MAKE) -j2 fast-tests lint

# one thread per process: with more threads, the matrix products of NumPy, SciPy and scikit-learn block one another,
# and kernels of short logs take longer to hand over than to run
all-tests fast-tests keep-numbers: export OPENBLAS_NUM_THREADS = 1
all-tests fast-tests keep-numbers: export OMP_NUM_THREADS = 1
all-tests fast-tests keep-numbers: export NUMBA_NUM_THREADS = 1
# memory of large arrays stays with the process: getting it anew takes half of the time spent in the kernel of Linux
all-tests fast-tests keep-numbers: export MALLOC_MMAP_THRESHOLD_ = 1073741824
all-tests fast-tests keep-numbers: export MALLOC_TRIM_THRESHOLD_ = 4294967296
all-tests fast-tests keep-numbers: export MALLOC_TOP_PAD_ = 67108864

all-tests: .venv/with-test
	$(BIN)/pytest -n logical --dist loadfile

fast-tests: .venv/with-test
	$(BIN)/pytest -n logical --dist loadfile -m "not paper"

# lines and branches that no test runs; kernels are machine code, so coverage does not see their lines
coverage: .venv/with-test
	$(BIN)/pytest --cov --cov-branch --cov-context=test --cov-report=html:build/coverage --cov-report=term $(TESTS)

lint: .venv/with-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.prose.check

wheel: .venv/with-test
	$(BIN)/python -m build --outdir dist

# mutation testing by cosmic-ray, of changed lines or ON=replay/inference; see tests/mutation.py
mutants: .venv/with-mutation
	ON="$(ON)" TESTS="$(TESTS)" COUNT="$(or $(COUNT),100)" $(BIN)/python -m tests.mutation

bench: .venv/with-bench
	$(BIN)/python -m tests.bench

# every model with every method that deploys: the C code compared with the replay
deployed: .venv/with-test
	$(BIN)/python -m tests.deployed

faults: .venv/with-test
	$(BIN)/python -m tests.faults

docs: .venv/with-test
	$(BIN)/python -m tests.claims render
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

docs-claims: .venv/with-test
	$(BIN)/python -m tests.claims run $(NAMES)
	$(BIN)/python -m tests.claims render

# stores the numbers that tests find, and prints the changes: for all tests with stored numbers, or for TESTS
keep-numbers: .venv/with-test
	$(BIN)/pytest -n logical --dist loadfile --keep-numbers $(or $(TESTS),tests/recorders tests/pipeline)

format: .venv/with-test
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf .venv demo out site build dist *.egg-info

.venv/with-fuselog: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) --editable .
	@touch $@

.venv/with-test: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) --editable '.[docs,test]'
	$(BIN)/python tests/links.py
	@touch .venv/with-fuselog
	@touch $@

.venv/with-mutation: .venv/with-test
	$(INSTALL) --editable '.[mutation]'
	@touch $@

.venv/with-bench: .venv/with-fuselog
	$(INSTALL) --editable '.[bench]'
	@touch $@
