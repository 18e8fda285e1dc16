# Each target alone sets up .venv and does its job; only Python 3.11 or newer and a package index are needed.
PYTHON ?= python3.11

.PHONY: demo test golden clean

demo: .venv/ready
	.venv/bin/fieldlum demo demo

test: .venv/ready
	.venv/bin/ruff check .
	.venv/bin/pyright
	.venv/bin/pytest -q -n 2

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install -q --upgrade "pip>=25.1"
	.venv/bin/python -m pip install -q -c constraints.txt -e . --group dev
	touch .venv/ready

# Stores the results of the whole chain again, after an intended change of results.
golden: .venv/ready
	.venv/bin/python tests/golden_chain.py

clean:
	rm -rf .venv demo
