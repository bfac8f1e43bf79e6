# `make demo` and `make test` set up all they need in .venv; a second call does no set-up work.
PYTHON ?= python3
BIN := .venv/bin

# Quiet and quick Ray on small machines; nothing calls home.
export RAY_AUTH_MODE ?= disabled
export RAY_USAGE_STATS_ENABLED ?= 0
export DO_NOT_TRACK ?= true
export MLFLOW_DISABLE_TELEMETRY ?= true
# Threads that wait for each other give their core away: spinning ones slow torch fivefold beside a busy process.
export OMP_WAIT_POLICY ?= PASSIVE

# Each of Ray's processes imports the same modules: without their bytecode each compiles them anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test lint clean
demo: .venv/ready
	$(BIN)/python jobs/run_demo.py --output runs/demo

test: export RAY_DATA_USE_DATASOURCE_V2 = 0
test: export RAY_TRAIN_HEALTH_CHECK_INTERVAL_S = 0.2
test: export RAY_worker_niceness = 0
test: export OMP_NUM_THREADS = 1
test: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -q -n 2 --dist loadfile

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

.venv/ready: pyproject.toml infra/constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	PIP_CONSTRAINT=infra/constraints.txt $(BIN)/pip install --disable-pip-version-check -q -e '.[dev]'
	@# The schemas of OpenDRIVE, for a test; what else is in there wants an older numpy.
	$(BIN)/pip install --disable-pip-version-check -q --no-deps asam-qc-opendrive==1.0.0
	@# Khronos' validator of glTF, for a test that is skipped without it.
	-command -v npm >/dev/null && npm install --silent --no-fund --no-audit --prefix .venv/npm gltf-validator@2.0.0-dev.3.10
	touch $@

clean:
	rm -rf .venv runs build *.egg-info
