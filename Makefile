# Each target alone sets up .venv and does its job; only Python 3.11 or newer and a package index are needed.
# The oldest Python that fits comes first, because its wheels exist; PYTHON=... chooses another.
PYTHON ?= $(firstword $(foreach name,python3.11 python3.12 python3.13 python3.14 python3 python,\
  $(shell $(name) -c "import sys; sys.version_info >= (3, 11) and print('$(name)')" 2>/dev/null)))
unexport PYTHONDONTWRITEBYTECODE  # pytest's rewritten test files are kept between runs

.PHONY: demo check test matrix matrix-short golden docs clean

demo: .venv/ready
	.venv/bin/fieldlum demo demo

# While you work: no types, no test that computes for over 0.3 s. Times are in CONTRIBUTING.md.
check: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/ruff format --check -q .
	.venv/bin/pytest -q -n 2 -m "not slow"

# Before each push. pyright runs next to the tests: it needs one core for a minute or more.
test: .venv/ready
	.venv/bin/ruff check .
	@.venv/bin/pyright & types=$$!; .venv/bin/pytest -q -n 2; tests=$$?; wait $$types && exit $$tests

.venv/ready: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or newer: install one, for example with" \
	  "'apt install python3 python3-venv', 'brew install python' or from python.org"; exit 1; }
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -q --upgrade "pip>=25.1"
	.venv/bin/python -m pip install -q -c constraints.txt -e . --group dev
	touch .venv/ready

# The whole suite under the arithmetic of other processors: eight times as long as `make test`.
matrix: .venv/ready
	.venv/bin/python bench/numeric_matrix.py -n 2

# Its short form: the tests that compare bits or train, under three of the settings.
matrix-short: .venv/ready
	.venv/bin/python bench/numeric_matrix.py --short --jobs 2

# Stores the results of the whole chain again, after an intended change of results.
golden: .venv/ready
	.venv/bin/python tests/golden_chain.py

# The site, docs/_build/html/index.html; a broken link is an error.
docs: .venv/ready
	.venv/bin/sphinx-build -q -W --keep-going -b html docs docs/_build/html

clean:
	rm -rf .venv demo docs/_build
