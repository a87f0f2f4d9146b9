# make setup | demo | test | lint | docs-pictures | clean
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup demo test lint docs-pictures clean

setup: $(STAMP)

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet 'torch>=2.6,<2.14'
	$(BIN)/python -m pip install --quiet -e '.[dev]'
	touch $(STAMP)

demo: setup
	mkdir -p out
	$(BIN)/dro-grasp generate --hand allegro --object rubber_duck --num 16 --seed 0 \
		--output out/demo.parquet --picture out/demo.png

test: setup
	$(BIN)/python -m pytest -n 2 -q

lint: setup
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/pyright

docs-pictures: setup
	$(BIN)/dro-grasp generate --hand allegro --object rubber_duck --num 16 --seed 0 --picture docs/pictures/grasps.png

clean:
	rm -rf out build dist
