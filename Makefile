# Every target sets up .venv by itself. Needs Python 3.11, 3.12 or 3.13 with venv, and make. Another interpreter, in a
# folder of its own: make test PYTHON=python3.13 VENV=.venv-3.13
PYTHON ?= $(or $(firstword $(foreach each,python3.11 python3.12 python3.13,$(shell $(each) -c 'print("$(each)")' 2>/dev/null))),\
	$(error no python3.11, python3.12 or python3.13 found; install one, or name one by PYTHON=))
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
# Without bytecode each of the tests' programs would compile all sources anew. Tests of the recorder wait for devices, so
# two cores have work for three processes.
test: export PYTHONDONTWRITEBYTECODE :=
# Its theme warns of a later release on every build; the version is locked.
export NO_MKDOCS_2_WARNING := 1
# The newest picture of the demo and its logs end up here.
DEMO := build/demo

.PHONY: setup demo test lint format docs pictures bench lock proto clean

setup: $(READY)

$(READY): requirements.lock pyproject.toml
	@echo "setup, step 1 of 4: a virtual environment in $(VENV) (a few seconds)"
	@$(PYTHON) -m venv $(VENV)
	@echo "setup, step 2 of 4: the packages of requirements.lock (about a minute, longer on a slow network)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@echo "setup, step 3 of 4: groundsbot itself (a few seconds)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@echo "setup, step 4 of 4: the compiled code of the solver"
	@$(BIN)/python -m groundsbot.offline.commands.compilation
	@touch $@

demo: $(READY)
	rm -rf $(DEMO)
	$(BIN)/python -m groundsbot.fixtures demo --output $(DEMO)

test: $(READY)
	$(BIN)/python -m groundsbot.offline.commands.compilation # else each of the processes would compile after an edit
	$(BIN)/python -m pytest --numprocesses 3 --dist worksteal

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m tests.project.names

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# The site: the commands' page from the programs, then everything, from disk.
docs: $(READY)
	$(BIN)/python docs/site/commands.py
	$(BIN)/mkdocs build --strict

# Those of README and docs, anew; the second needs Debian's Chromium.
pictures: demo
	cp $(DEMO)/map/map.png docs/merged_map.png
	chromium --headless=new --no-sandbox --disable-gpu --hide-scrollbars --window-size=1100,1100 \
		--virtual-time-budget=20000 --user-data-dir=build/chromium --screenshot=docs/report.png \
		file://$(CURDIR)/$(DEMO)/map/report.html

# All of them, then what missed a bound.
BENCHES := tests.benchmarks $(addprefix tests.benchmarks.speed.,fleet solver_bench solver_scaling stages_bench \
	corners_bench thinning_bench compile_bench)

bench: $(READY)
	@missed=; for each in $(BENCHES); do $(BIN)/python -m $$each || missed="$$missed $$each"; done; \
	test -z "$$missed" || { echo "missed a bound:$$missed"; exit 1; }

# Writes both locks anew: exact versions and hashes for every platform; the robot has no other versions.
lock: $(READY)
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url \
		--extra robot --extra laptop --group dev --upgrade pyproject.toml --output-file requirements.lock \
		--custom-compile-command "make lock"
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url \
		--extra robot --constraint requirements.lock pyproject.toml --output-file requirements-robot.lock \
		--custom-compile-command "make lock"

proto: $(READY)
	$(BIN)/python -m grpc_tools.protoc --proto_path=. --python_out=. --pyi_out=. onboard/groundsbot.proto
	sed -i "s/'onboard.groundsbot_pb2'/'groundsbot.onboard.groundsbot_pb2'/" onboard/groundsbot_pb2.py

clean:
	rm -rf build $(VENV)
