# Shortcuts; bootstrap.py does the work and runs where there is no make.
.PHONY: setup demo test package format docs

setup demo test package:
	python3 bootstrap.py $@

format:
	.venv/bin/python -m ruff check --fix .
	.venv/bin/python -m ruff format .

docs:
	python3 docs/make_options.py
