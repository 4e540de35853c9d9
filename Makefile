# Two commands on a fresh machine with Python 3.11+ and make: `make demo` and `make test`. Each installs what it needs.

# If it is set, each worker of pytest compiles every test again.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_READY := $(VENV)/.demo
READY := $(VENV)/.ready
REST := \# What follows is for work on the repository.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
DEMO := build/demo
THREADS := 2
ROOMS := foundation drivers sim experiment calibration acquisition synthesis generator evaluation

.PHONY: install demo test suite quick lint docs bench full-session lock clean

# First part of the lock: a plain installation, and the photographs of the demo.
$(DEMO_READY): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, this is " + sys.version.split()[0] + "; name one with make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	sed '/^$(REST)/,$$d' requirements.lock | $(INSTALL) --requirement /dev/stdin
	$(INSTALL) --no-deps --editable .
	touch $@

$(READY): $(DEMO_READY)
	$(INSTALL) --requirement requirements.lock
	touch $@

# Install the needs of the demo into .venv: a plain installation and a few photographs.
install: $(DEMO_READY)

# The whole workflow in the simulated laboratory, with 12 illuminants and full-size frames.
demo: $(DEMO_READY)
	rm -rf $(DEMO)
	mkdir -p $(DEMO)
	$(BIN)/acquire chart $(DEMO)/chart --no-tiff
	$(BIN)/acquire illuminations $(DEMO)/illuminations.csv --grid 2 --blackbodies 2500:10000:1500
	$(BIN)/acquire init $(DEMO)/. --rig simulated
	$(BIN)/acquire check $(DEMO)/LAB.toml --picture $(DEMO)/check.png
	$(BIN)/acquire run $(DEMO)/LAB.toml $(DEMO)/session
	$(BIN)/build-lut $(DEMO)/session $(DEMO)/lut
	$(BIN)/python examples/photographs.py $(DEMO)/photographs
	$(BIN)/generate $(DEMO)/lut $(DEMO)/dataset --sources $(DEMO)/photographs --light 0-11 --contact-sheet $(DEMO)/contact_sheet.png
	$(BIN)/evaluate $(DEMO)/dataset
	$(BIN)/evaluate cv kernel-ridge $(DEMO)/dataset
	$(BIN)/evaluate train kernel-ridge $(DEMO)/dataset --out $(DEMO)/model.npz
	@echo
	@echo "Raw linear images with their ground truth:  $(CURDIR)/$(DEMO)/dataset"
	@echo "Report on the look-up table (LUT):          $(CURDIR)/$(DEMO)/lut/report.html"
	@echo "Look at this first:                         $(CURDIR)/$(DEMO)/contact_sheet.png"

# Lint runs in parallel with the tests, which sometimes wait for programs; one thread needs the least total time.
test: $(READY)
	$(MAKE) --no-print-directory --jobs 2 --output-sync=line THREADS=1 lint suite

suite: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal

# Test functions that take at most 0.1 s; they find most mistakes.
quick: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyrefly check --threads $(THREADS) --progress-bar no --min-severity error

# Site with tutorial, how-to, reference and explanation; warnings are errors. Needs no network.
docs: $(READY)
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --jobs auto --doctree-dir build/doctrees docs build/site
	@echo "The site: $(CURDIR)/build/site/index.html"

bench: $(READY)
	@for file in benchmarks/[!_]*.py; do $(BIN)/python -m benchmarks.$$(basename $$file .py) || exit 1; done

# A complete LUT of 707 illuminants from full-size simulated frames: at least half an hour and 60 GB of disk space.
full-session: $(DEMO_READY)
	$(BIN)/python examples/full_session.py build/full-session

# Write the lock from pyproject.toml again, the part of the demo first; needs the network.
COMPILE = $(BIN)/uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-emit-find-links --no-annotate --custom-compile-command "make lock" --quiet --extra demo
lock:
	mkdir -p build
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet uv
	$(COMPILE) --extra dev --extra docs --upgrade --output-file build/all.lock
	$(COMPILE) --constraint build/all.lock --upgrade --output-file build/demo.lock
	{ cat build/demo.lock; echo; echo '$(REST)'; \
		awk 'NR == FNR { if (/==/) demo[$$0]; next } /==/ { kept = !($$0 in demo) } kept' build/demo.lock build/all.lock; \
	} > requirements.lock

clean:
	rm -rf build $(VENV)
