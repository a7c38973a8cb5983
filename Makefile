# make demo, make test: each does all of its own set-up in .venv; only Python 3.11 or newer is needed.
# make docs makes the pages' tables from the stored results, and the site from the pages, in site/;
# make docs-claims FUSELOG_DATA=FOLDER runs the experiments first, all or those that NAMES="..." lists.
PYTHON ?= $(shell command -v python3.11 || command -v python3 || command -v python)
BIN := .venv/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# --no-compile: Python compiles the modules that are imported, which are few of them
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# commands are started some hundred times: what they import is compiled once, whatever is usual here
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-fast coverage fast-replay-lane fast-rooms-lane estimators-lane inference-lane pipeline-lane rooms-lane lint wheel mutants bench deployed faults docs docs-claims format clean

demo: .venv/with-fuselog
	$(BIN)/fuselog run landmarks --runs 20 --out demo/landmarks
	$(BIN)/fuselog report demo/landmarks --out demo/report.html
	@echo
	@echo "Scrub the timeline:  $(BIN)/fuselog view demo/landmarks"
	@echo "Read the report:     demo/report.html (open it in a browser)"
	@echo "Summary figure:      demo/landmarks/figures/errors-robot1.svg"
	@echo "Logs and estimates:  demo/landmarks/logs, demo/landmarks/estimates (MCAP)"
	@echo "Tables and numbers:  demo/landmarks/tables, demo/landmarks/result.json"

# all tests, in four lanes of like length, and the linters, side by side; what is about one family is in
# one lane, so that what its kernels share is compiled once: studies are with the estimators
test: .venv/with-test
	$(MAKE) -j5 pipeline-lane estimators-lane inference-lane rooms-lane lint

test-fast: .venv/with-test
	$(MAKE) -j3 fast-replay-lane fast-rooms-lane lint

fast-rooms-lane: .venv/with-test
	$(BIN)/pytest -m "not paper" tests/docs tests/house tests/pipeline

fast-replay-lane: .venv/with-test
	$(BIN)/pytest -m "not paper" tests --ignore=tests/docs --ignore=tests/house --ignore=tests/pipeline

estimators-lane: .venv/with-test
	$(BIN)/pytest tests/replay/estimators tests/replay/test_goldens.py tests/pipeline/test_*stud*.py \
		tests/pipeline/test_deploying.py

inference-lane: .venv/with-test
	$(BIN)/pytest tests/replay tests/pipeline/test_tuning.py tests/pipeline/test_campaigns.py \
		--ignore=tests/replay/estimators --ignore=tests/replay/test_goldens.py

pipeline-lane: .venv/with-test
	$(BIN)/pytest tests/pipeline --ignore-glob='*stud*.py' --ignore=tests/pipeline/test_faults.py \
		--ignore=tests/pipeline/test_outputs.py --ignore=tests/pipeline/test_tuning.py \
		--ignore=tests/pipeline/test_campaigns.py --ignore=tests/pipeline/test_deploying.py \
		--ignore-glob='*test_command_*.py'

rooms-lane: .venv/with-test
	$(BIN)/pytest tests/claims tests/docs tests/house tests/recorders tests/words \
		tests/pipeline/test_faults.py tests/pipeline/test_outputs.py tests/pipeline/test_command_*.py

# what no test runs, by lines and branches; kernels are machine code, of which no line is seen
coverage: .venv/with-test
	$(BIN)/pytest --cov --cov-branch --cov-context=test --cov-report=html:build/coverage --cov-report=term $(TESTS)

lint: .venv/with-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

wheel: .venv/with-test
	$(BIN)/python -m build --outdir dist

# mutation testing by cosmic-ray, of changed lines or ON=replay/inference; see tests/mutation.py
mutants: .venv/with-mutation
	ON="$(ON)" TESTS="$(TESTS)" COUNT="$(or $(COUNT),100)" $(BIN)/python -m tests.mutation

bench: .venv/with-bench
	$(BIN)/python -m tests.bench

# every model by every method that deploys, in C beside its replay
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
	@touch .venv/with-fuselog
	@touch $@

.venv/with-mutation: .venv/with-test
	$(INSTALL) --editable '.[mutation]'
	@touch $@

.venv/with-bench: .venv/with-fuselog
	$(INSTALL) --editable '.[bench]'
	@touch $@
