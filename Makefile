# make setup | demo | demo-arm | test | test-slow | test-full | data | labels | weights | rehearse | results | results-stale | results-confirm | tables | release-check | lint | docs | clean
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup demo demo-arm test test-slow test-full results results-stale results-confirm tables golden lint wheels release-check licences docs rehearse rehearse-bare docs-pictures data labels weights clean

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

demo-arm: setup  # a robot sees an object on a table, plans and lifts it; out/lift.webp shows it
	mkdir -p out
	$(BIN)/dro-grasp tabletop --robot xarm7_leaphand --objects spray_bottle --attempts 1 \
		--output out/lift.parquet --video out/lift.webp

test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -q

test-slow: setup  # what is slow, starts a browser or Ray, or builds the wheel, with shape checks
	CHECK_SHAPES=1 $(BIN)/python -m pytest -q -m alone
	CHECK_SHAPES=1 $(BIN)/python -m pytest -n 2 --dist worksteal -q -m 'slow and not gpu and not alone'

test-full: test-slow  # every test, with shape checks
	CHECK_SHAPES=1 $(MAKE) test

NAMES :=
results: setup  # measure what is missing or older than its code (NAMES="headline speed"; everything takes a night)
	$(BIN)/python -m lab.runner $(NAMES)

results-stale: setup  # what is missing or older than the code that it measures
	$(BIN)/python -m lab.runner --stale $(NAMES)

results-confirm: setup  # whether what is older than its code would come out the same: one command of each is run with both
	$(BIN)/python -m lab.confirm $(NAMES)

tables: setup  # write tables, numbers and figures of README and docs from lab/results
	$(BIN)/python -m lab.tables

golden: setup  # record anew what tests/golden compares, after a change that is meant to change results
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.golden.cases

lint: setup
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/pyright
	$(BIN)/pyright --pythonversion 3.13

wheels: setup  # every runtime dependency has a wheel for the newer Pythons; needs the package index
	$(BIN)/python scripts/check_wheels.py 3.12 3.13

release-check: setup  # build wheel and sdist, install each extra in a fresh environment, use it far from here; downloads
	$(BIN)/python -m lab.release $(if $(PYTHONS),--python $(BIN)/python $(PYTHONS)) $(if $(EXTRAS),--extras $(EXTRAS))

licences: setup  # list the licences of all that is installed with the package, in docs/licences.md
	$(BIN)/python -m lab.licences

docs: setup  # the documents as a site in out/site; fails on unknown names and broken links
	$(BIN)/zensical build --strict --clean

# What these need: hours, and DRO_GRASP_ASSETS. Stop or kill them, and run them again: they go on. TINY=1 rehearses in minutes.
RECIPE = $(BIN)/python -m lab.recipe
RECIPE_OPTIONS = $(if $(TINY),--tiny --folder out/tiny) $(if $(DEVICE),--device $(DEVICE)) $(if $(WORKERS),--workers $(WORKERS))

data: setup  # synthesize grasps that hold (MINUTES=600 stops then, with grasps of all pairs)
	$(RECIPE) data $(RECIPE_OPTIONS) $(if $(MINUTES),--minutes $(MINUTES))

labels: setup  # keep what of the shipped grasps passes carry and robust, and merge it with the data
	$(RECIPE) labels $(RECIPE_OPTIONS)

weights: setup  # bundle, pretrain, train, scores, completion; then the set is put where it ships (GRASPS=FOLDER: of these grasps)
	$(RECIPE) weights $(RECIPE_OPTIONS) $(if $(GRASPS),--grasps $(GRASPS))

rehearse: setup  # data, labels and weights in small, without assets, killed once
	rm -rf out/tiny
	-timeout --signal KILL 60 $(RECIPE) data labels weights --tiny --folder out/tiny
	$(RECIPE) data labels weights --tiny --folder out/tiny

REHEARSAL := out/rehearsal
rehearse-bare: setup  # the training of a GPU machine with the slim network, in two minutes here: killed once, then finished
	rm -rf $(REHEARSAL) && mkdir -p $(REHEARSAL)/out
	$(BIN)/dro-grasp synthesize --hand barrett gripper3 --object can torus --grasps 8 --output $(REHEARSAL)/data
	$(BIN)/dro-grasp dataset bundle $(REHEARSAL)/data --output $(REHEARSAL)/bundle.safetensors
	export PATH=$(abspath $(BIN)):$$PATH OMP_NUM_THREADS=1 PROCESSES=2 RUNS=$(REHEARSAL)/runs OUT=$(REHEARSAL)/out \
		BUNDLE=$(REHEARSAL)/bundle.safetensors VALIDATION=$(REHEARSAL)/bundle.safetensors \
		PRETRAIN='--preset slim --steps 4 --motion-steps 4' TRAIN='--preset slim --steps 10 --validation-samples 20'; \
	timeout --signal KILL 20 scripts/train_on_bare_machine.sh; scripts/train_on_bare_machine.sh
	cd $(REHEARSAL)/out && cat multi.safetensors.* > multi.safetensors && sha256sum --check multi.sha256
	$(BIN)/dro-grasp weights verify $(REHEARSAL)/out/multi.safetensors

docs-pictures: setup
	$(BIN)/dro-grasp generate --hand allegro --object rubber_duck --num 8 --seed 0 --picture docs/pictures/grasps.png
	$(BIN)/dro-grasp tabletop --robot xarm7_leaphand --objects spray_bottle --attempts 1 --video docs/pictures/lift.webp
	$(BIN)/dro-grasp clear --robot xarm7_leaphand --objects builtin:train --things 5 --video docs/pictures/clear.webp
	$(BIN)/dro-grasp robot check xarm7_leaphand --picture docs/pictures/robot-check.png
	$(BIN)/dro-grasp tabletop --robot xarm7_leaphand --objects builtin:test --attempts 2 --output out/attempts.parquet --plans out/plans
	$(BIN)/python scripts/draw_attempts.py out/attempts.parquet out/plans docs/pictures/attempts.png
	$(BIN)/dro-grasp hand check leaphand --picture docs/pictures/hand-check.png
	$(BIN)/python scripts/draw_rooms.py docs/pictures/rooms.png
	$(BIN)/python scripts/draw_gallery.py docs/pictures/gallery.png
	$(BIN)/python -m scripts.draw_studio docs/pictures/studio.png
	$(BIN)/python -m scripts.draw_scene_page docs/pictures/scene-page.png

clean:
	rm -rf out build dist
