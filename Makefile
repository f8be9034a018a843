.PHONY: install test lint bench site ci

install: ## an environment with everything that the tests need
	python3 -m venv .venv && .venv/bin/pip install -q -e ".[dev]"

test: ## all tests but the slow ones, on all cores
	.venv/bin/python -m pytest -q -n auto --dist loadfile

lint: ## style, types and layers
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy && .venv/bin/lint-imports

bench: ## speed of the simulation and of an update, written to benchmarks.json
	.venv/bin/python -m pytest tests/benchmarks --benchmark-enable --benchmark-json=benchmarks.json

site: ## the documentation as web pages, in build/site
	python3 -m venv .venv-site && .venv-site/bin/pip install -q -r docs/site/requirements.txt && .venv-site/bin/mkdocs build -q

ci: ## everything that must pass before a change lands
	.ci/run
