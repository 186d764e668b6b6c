# Two commands do everything on a fresh machine:
#   make compare   set up .venv and run the paper's comparison
#   make test      set up .venv with the test extras and run the suite
# PYTHON=python3.12 chooses the interpreter; make install sets .venv up and runs nothing.
# For every save:
#   make quick     the unit tests alone
# Before a release:
#   make thorough  the suite with twenty times the examples of every property
# And for whoever must trust it on an arm:
#   make faults    break things on purpose and count what came of it
# The documentation as a site:
#   make docs      build/site/index.html
# Options for hpid compare: make compare ARGS="FILE --output FOLDER --in-process"

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install compare test quick thorough faults bench lint docs clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# setuptools warns of every editable install; it is meant to be one.
$(VENV)/.installed: setup.py setup.cfg package.xml | $(BIN)/python
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros]"
	touch $@

$(VENV)/.test-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,test]"
	touch $@

$(VENV)/.docs-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,docs]"
	touch $@

$(VENV)/.bench-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,bench]"
	touch $@

install: $(VENV)/.installed

compare: $(VENV)/.installed
	$(BIN)/hpid compare $(ARGS)

# Each file on one of so many processes, the long ones first; graphs have domains of their own.
JOBS ?= 2
SPREAD := -n $(JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

thorough: PROFILE := --hypothesis-profile thorough
thorough: test

# What keeps the time of the wall has the machine to itself.
test: $(VENV)/.test-installed
ifeq ($(strip $(ARGS)),)
	$(BIN)/python -m pytest $(PROFILE) $(SPREAD) -m "not alone"
	$(BIN)/python -m pytest $(PROFILE) -m alone
else
	$(BIN)/python -m pytest $(ARGS)
endif

quick: $(VENV)/.test-installed
	$(BIN)/python -m pytest $(SPREAD) -m "unit and not slow" -q $(ARGS)

# The tests that break things on purpose, and a table of what they did and what came of it.
# Longer: python -m benchmarks.faults --minutes 10, python -m benchmarks.soak --minutes 60
faults: $(VENV)/.test-installed
	HPID_SOAK_MINUTES=$${HPID_SOAK_MINUTES:-2} $(BIN)/python -m pytest --faults $(ARGS)

bench: $(VENV)/.bench-installed
	$(BIN)/python -m benchmarks $(ARGS)

lint: $(VENV)/.test-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/biome ci

# The site, in build/site/index.html; every warning is an error.
docs: $(VENV)/.docs-installed
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/site

clean:
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
