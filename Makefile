# Two commands do everything on a fresh machine:
#   make compare   set up .venv and run the paper's comparison
#   make test      set up .venv with the test extras and run the suite
# and one to play with:
#   make play      the simulated robot, its controllers and the live page
# PYTHON=python3.12 chooses the interpreter; make install sets .venv up and runs nothing.
# What CI runs with it (.ci/run); tools/repeat_tests.sh repeats all of them:
#   make faults    break things on purpose, and a table of what was done and what came of it
#   make repository  packaging, documentation, layout, examples and benchmarks; make lint runs it, too
#   make busy      tests of nodes and faults once more, beside two busy loops
# For every save:
#   make quick     the unit tests alone
# Before a release:
#   make thorough  the suite with twenty times the examples of every property
# The documentation as a site:
#   make docs      build/site/index.html
# Options for hpid compare: make compare ARGS="FILE --output FOLDER --in-process"

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install compare play test faults repository busy quick thorough bench lint docs clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# setuptools warns of every editable install; it is meant to be one.
$(VENV)/.installed: setup.py setup.cfg package.xml | $(BIN)/python
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,bench]"
	touch $@

$(VENV)/.test-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,bench,test]"
	touch $@

$(VENV)/.docs-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,bench,docs]"
	touch $@

$(VENV)/.peers-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,bench,peers]"
	touch $@

install: $(VENV)/.installed

compare: $(VENV)/.installed
	$(BIN)/hpid compare $(ARGS)

$(VENV)/.live-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable ".[ros,live]"
	touch $@

play: $(VENV)/.live-installed
	$(BIN)/hpid play $(ARGS)

# Each file on one of so many processes; graphs have domains of their own. More processes
# than cores: half of the time a test of nodes waits (test/conftest.py spreads them).
JOBS ?= 5
SPREAD = -n $(JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0
PYTEST = $(BIN)/python -m pytest $(PROFILE)

thorough: PROFILE := --hypothesis-profile thorough
thorough: test faults

# Files with a marker: to import all the others to collect few takes longer than to run some.
with = $(shell grep -rl '$(1)' test --include='test_*.py')

# In three parts, each of which runs whatever became of the others: what keeps the time of the wall
# has the machine to itself, and the closed mode its own process.
parts = @failed=; \
	$(PYTEST) $(SPREAD) -m "$(1) and not alone and not closed" $(2) || failed="$$failed main"; \
	$(PYTEST) -m "$(1) and closed" test/closed $(call with,mark.closed) || failed="$$failed closed"; \
	$(PYTEST) -m "$(1) and alone and not closed" $(call with,mark.alone) || failed="$$failed alone"; \
	$(BIN)/python test/harness/browser.py; \
	test -z "$$failed" || { echo "failed:$$failed"; exit 1; }

test: $(VENV)/.test-installed
ifeq ($(strip $(ARGS)),)
	$(call parts,not faults and not repository)
else
	$(PYTEST) $(ARGS)
endif

# Longer: HPID_SOAK_MINUTES=60, python -m benchmarks.faults --minutes 10
faults: $(VENV)/.test-installed
	$(call parts,faults,test/faults $(call with,[ .]faults))

repository: $(VENV)/.test-installed
	$(PYTEST) $(SPREAD) -m repository -q $(call with,mark.repository) $(ARGS)

busy: JOBS := 2
busy: $(VENV)/.test-installed
	@(while :; do :; done) & first=$$!; (while :; do :; done) & second=$$!; \
	trap "kill $$first $$second" EXIT; trap "exit 1" INT TERM; failed=0; \
	$(PYTEST) $(SPREAD) -m "not alone and not closed" test/graph test/field test/faults $(ARGS) || failed=1; \
	$(PYTEST) -m "not alone" test/closed $(ARGS) || failed=1; \
	exit $$failed

quick: JOBS := 2
quick: PROFILE := --hypothesis-profile quick
quick: $(VENV)/.test-installed
	$(PYTEST) $(SPREAD) -m "not slow and not repository" -q test/unit $(ARGS)

bench: $(VENV)/.peers-installed
	$(BIN)/python -m benchmarks $(ARGS)

lint: repository
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/biome ci

# The site, in build/site/index.html; every warning is an error.
docs: $(VENV)/.docs-installed
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/site

clean:
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
