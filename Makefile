# make render   set everything up, then render a bundled scene into out/
# make test     set everything up, then run the tests (10 to 25 minutes on two cores)
# make test-long the tests that take longest (ten minutes)
# make test-all all of these, and all extended cases (an hour and a half)
# make mutants  set everything up, then see how many of more than a hundred errors the tests find (twenty minutes)
# make bench    set everything up, then compare all methods on all bundled scenes: out/bench/index.html (half an hour to three quarters)
# make figures set everything up, then measure all figures of docs/results.md anew (two hours)
# make lint     set everything up, then check style, layout and type hints
# make gallery  set everything up, then render the pictures of docs/ (half an hour)
# make hero     set everything up, then render the pictures of README.md (half an hour)
# make docs     set everything up, then build the documentation site: out/site/index.html

PYTHON ?= python3
VENV := .venv
SETUP := tools/setup.sh

.PHONY: render test test-long test-all mutants lint bench figures gallery hero docs clean
.DELETE_ON_ERROR:

render: $(VENV)/installed
	@mkdir -p out
	$(VENV)/bin/mis-render scenes/cornell_glossy.xml -i bdpm_opt3 -o out/cornell_glossy.exr

test: $(VENV)/installed-test
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal

test-long: $(VENV)/installed-test
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal -m "long and not extended and not full"

test-all: $(VENV)/installed-test
	$(VENV)/bin/python -m pytest -n 2 --dist worksteal -m "not full"

mutants: $(VENV)/installed-test
	$(VENV)/bin/python tools/mutants.py

lint: $(VENV)/installed-test
	$(VENV)/bin/python -m ruff check
	$(VENV)/bin/python -m ruff format --check
	$(VENV)/bin/python -m mypy

gallery: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[bench,denoise]'
	@mkdir -p docs/images out
	@for scene in scenes/*.xml; do name=$$(basename $$scene .xml); \
	    $(VENV)/bin/mis-render $$scene -i bdpm_auto --seed 1 --time 60 -o out/$$name.exr && cp out/$$name.png docs/images/ || exit 1; done
	PYTHON=$(VENV)/bin/python tools/plugin_pictures.sh
	PYTHON=$(VENV)/bin/python tools/gallery.sh

hero: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[bench,denoise]'
	PYTHON=$(VENV)/bin/python tools/hero.sh

docs: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

bench: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(VENV)/bin/python benchmarks/run.py references --out out/bench
	$(VENV)/bin/python benchmarks/run.py page --out out/bench

figures: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[bench,denoise]'
	$(VENV)/bin/python benchmarks/run.py figures

$(VENV)/installed: pyproject.toml $(SETUP)
	@$(SETUP) $(PYTHON) $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/installed-test: $(VENV)/installed
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@

clean:
	rm -rf $(VENV) out build *.egg-info
