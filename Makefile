# Each target sets up what it needs in .venv; a second call does no set-up work.
#
#   make demo        train, sample and report with the demo preset
#   make paper-kitti360 ROOT=DIR     train and evaluate the paper's models on KITTI-360, and write the paper's tables
#   make paper-av2 ROOT=DIR          the same on Argoverse 2; for options such as --dry-run add ARGS="--dry-run"
#   make lint        ruff (rules and format) and pyright
#   make test-fast   tests/unit: no Ray, no browser, about three minutes
#   make test        all tests but slow ones
#   make test-slow   long checks, marked slow
#   make docs        the documentation site in build/site; executes the tutorials
#   make py123d-env  an environment with py123d in .venv-py123d, which converts further datasets
#   make coverage    make test with line coverage, without lines in Ray's processes; half as long again
PYTHON ?= python3
BIN := .venv/bin
# Two processes, one per core of CI.
PYTEST := $(BIN)/python -m pytest -q -n 2

# Quiet and quick Ray on small machines; no telemetry.
export RAY_AUTH_MODE ?= disabled
export RAY_USAGE_STATS_ENABLED ?= 0
export DO_NOT_TRACK ?= true
export MLFLOW_DISABLE_TELEMETRY ?= true
# Waiting threads yield their core: spinning ones slow torch fivefold next to a busy process.
export OMP_WAIT_POLICY ?= PASSIVE

# All processes of Ray import the same modules: without bytecode on disk each compiles them again.
unexport PYTHONDONTWRITEBYTECODE

TESTS := test test-fast test-slow coverage
.PHONY: demo paper-kitti360 paper-av2 lint docs $(TESTS) browser py123d-env clean
demo: .venv/ready
	$(BIN)/python jobs/run_demo.py --output runs/demo

paper-kitti360 paper-av2: .venv/ready
	@test -n "$(ROOT)" || { echo "error: give the directory of the dataset: make $@ ROOT=DIR" >&2; exit 2; }
	PRITTI_HOME="$(CURDIR)/runs" $(BIN)/python jobs/reproduce_paper.py $(@:paper-%=%) --input "$(ROOT)" $(ARGS)

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: .venv/ready
	PATH="$(CURDIR)/$(BIN):$$PATH" NO_MKDOCS_2_WARNING=1 mkdocs build --quiet
	@echo "documentation: build/site/index.html"

$(TESTS): export RAY_DATA_USE_DATASOURCE_V2 = 0
$(TESTS): export RAY_TRAIN_HEALTH_CHECK_INTERVAL_S = 0.2
$(TESTS): export RAY_worker_niceness = 0
$(TESTS): export OMP_NUM_THREADS = 1

test-fast: .venv/ready
	$(PYTEST) tests/unit

test: .venv/ready browser
	$(PYTEST) -m "not slow"

test-slow: .venv/ready
	$(PYTEST) -m slow

coverage: .venv/ready browser
	$(PYTEST) -m "not slow" --cov --cov-report=term-missing:skip-covered

# CI needs a browser, as skipped browser tests fail there, and nginx for a test of infra/nginx.conf. Elsewhere this does
# nothing.
browser:
	@if [ "$$CI" = true ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && \
	    ! { command -v chromium && command -v chromedriver && command -v nginx; } >/dev/null; then \
	  apt-get update -q && \
	  DEBIAN_FRONTEND=noninteractive apt-get install -q -y chromium chromium-driver nginx-light; \
	fi

.venv/ready: pyproject.toml infra/constraints.txt
	@echo "installing packages to .venv, 1 to 5 minutes"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@# uv needs a fifth of pip's time. It does not read pip.conf, so pip is the fallback.
	( $(BIN)/pip install --disable-pip-version-check -q uv==0.13.9 && \
	    UV_SYSTEM_CERTS=1 VIRTUAL_ENV=.venv $(BIN)/uv pip install -q $${PIP_FIND_LINKS:+--find-links "$$PIP_FIND_LINKS"} \
	    $${PIP_INDEX_URL:+--default-index "$$PIP_INDEX_URL"} -c infra/constraints.txt -e '.[dev]' ) || \
	  PIP_CONSTRAINT=infra/constraints.txt $(BIN)/pip install --disable-pip-version-check -q -e '.[dev]'
	@# The OpenDRIVE schemas for a test. Its dependencies would install an older numpy.
	$(BIN)/pip install --disable-pip-version-check -q --no-deps asam-qc-opendrive==1.0.0
	@# The glTF validator of Khronos, for a test that is skipped without it.
	-command -v npm >/dev/null && npm install --silent --no-fund --no-audit --prefix .venv/npm gltf-validator@2.0.0-dev.3.10
	touch $@

# py123d needs an older trimesh than this project. The maps of CARLA in its wheel are read by tests.
py123d-env: .venv/ready
	test -x .venv-py123d/bin/python || $(PYTHON) -m venv .venv-py123d
	UV_SYSTEM_CERTS=1 $(BIN)/uv pip install -q -p .venv-py123d/bin/python \
	  $${PIP_INDEX_URL:+--default-index "$$PIP_INDEX_URL"} py123d==0.7.0 || \
	  .venv-py123d/bin/python -m pip install --disable-pip-version-check -q py123d==0.7.0

clean:
	rm -rf .venv .venv-py123d runs build dist *.egg-info .coverage
