# Two commands do everything on a fresh machine:
#   make compare   set up .venv and run the paper's comparison
#   make test      set up .venv with the test extras and run the suite
# PYTHON=python3.12 chooses the interpreter; make install sets .venv up and runs nothing.
#   make busy      tests of nodes once more, beside two busy loops; tools/repeat_tests.sh repeats all
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

.PHONY: install compare test busy quick thorough faults bench lint docs clean

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

# In three parts, each of which runs whatever became of the others: what keeps the time of the wall
# has the machine to itself, and the closed mode its own process.
test: $(VENV)/.test-installed
ifeq ($(strip $(ARGS)),)
	@failed=; \
	$(BIN)/python -m pytest $(PROFILE) $(SPREAD) -m "not alone and not closed" || failed="$$failed main"; \
	$(BIN)/python -m pytest $(PROFILE) -m closed || failed="$$failed closed"; \
	$(BIN)/python -m pytest $(PROFILE) -m "alone and not closed" || failed="$$failed alone"; \
	test -z "$$failed" || { echo "failed:$$failed"; exit 1; }
else
	$(BIN)/python -m pytest $(ARGS)
endif

# Nodes on graphs and faults, beside two busy loops.
busy: $(VENV)/.test-installed
	@(while :; do :; done) & first=$$!; (while :; do :; done) & second=$$!; \
	trap "kill $$first $$second" EXIT; trap "exit 1" INT TERM; failed=0; \
	$(BIN)/python -m pytest $(SPREAD) -m "(graph or faults) and not alone" $(ARGS) || failed=1; \
	$(BIN)/python -m pytest -m "closed and not alone" $(ARGS) || failed=1; \
	exit $$failed

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
