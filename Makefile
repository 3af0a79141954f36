# Everything a developer needs. Each target does its own set-up; a machine needs Python >= 3.11 and make.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed
TRAINER := $(BIN)/trainer
DEMO_DB := demo/trainer.db
DEMO_RRD := demo/stitch.rrd

.PHONY: demo test lint format bench docs lock clean

demo: $(INSTALLED)
	rm -rf demo && mkdir demo
	$(TRAINER) practice anastomosis/single-stitch --device scripted-expert --fast --db $(DEMO_DB) --record $(DEMO_RRD)
	$(BIN)/rerun rrd verify $(DEMO_RRD)
	@echo
	@echo "Log:       $(DEMO_DB)    (.venv/bin/trainer sessions list --db $(DEMO_DB))"
	@echo "Recording: $(DEMO_RRD)    (.venv/bin/rerun $(DEMO_RRD))"
	@echo "rerun sends usage statistics to its makers unless told not to: .venv/bin/rerun analytics disable"

# A file of tests stays with one worker: each kernel is compiled once, not once for every worker.
test: lint
	$(BIN)/python -m pytest -q -n auto --dist loadfile

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(INSTALLED)
	$(TRAINER) bench

# The README's pictures, from a fresh session. Needs a Vulkan driver and Chromium.
docs: demo
	$(TRAINER) report session last --db $(DEMO_DB) --html demo/report.html
	$(BIN)/python reports/pictures/draw.py $(DEMO_RRD) demo/report.html --at 3

# The versions that everybody runs. Hashes only: no address of any package index enters the file.
lock: $(INSTALLED)
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --extra test --generate-hashes --universal --upgrade --quiet -o requirements.lock

clean:
	rm -rf .venv build demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

# setuptools comes from the lock, so the package is built with it and nothing unpinned is fetched.
$(INSTALLED): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "trainer needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@
