# Each target alone sets up .venv and does its job; only Python 3.11 or newer and a package index are needed.
PYTHON ?= python3.11

.PHONY: demo test clean

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

clean:
	rm -rf .venv demo
