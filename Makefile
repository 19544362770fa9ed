# make test | quick | lint | formats | docs | dist | bundle | figures | long | mutants | viewers | page | model | ci
VENV ?= .venv-test
PYTHON ?= python3
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# CONSTRAINTS= installs the newest releases: for systems that the pins have no wheels for
CONSTRAINTS ?= -c constraints.txt

.PHONY: test quick lint format formats docs dist bundle figures long fuzz mutants viewers page model ci

$(BIN)/pytest: pyproject.toml constraints.txt
	[ -x $(BIN)/python ] || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -qq --disable-pip-version-check $(CONSTRAINTS) -e '.[test]'
	touch $@

test: $(BIN)/pytest
	$(BIN)/pytest -n 2 --dist loadfile

# While working, for less than a minute once kernels are compiled: the order of subpackages, pages, cameras, pictures, metrics, the
# splatter and the ray caster's scenes, transfer functions, most formats; ten examples a property, no conversions.
QUICK := architecture docs_pages cameras_blocks cameras_files images_compose images_files metrics_images \
	metrics_scores gaussians_ply optimize_loss splat_render dvr_scene look_readers look_resolve volume_affines \
	volume_headers volume_itk volume_raw volume_registry volume_tiff
quick: $(BIN)/pytest
	HYPOTHESIS_PROFILE=quick $(BIN)/pytest -n 2 --dist loadfile $(QUICK:%=tests/test_%.py)

lint: $(BIN)/pytest
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(BIN)/pytest
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Endings of files in modules of other programs, which cannot read our table of formats.
formats: $(BIN)/pytest
	$(BIN)/python -m tests.endings

# The documentation as a site that can be searched: out/docs/index.html.
docs: $(BIN)/pytest
	$(BIN)/pip install -qq --disable-pip-version-check $(CONSTRAINTS) -e '.[test,docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -c docs . out/docs

# Wheel and sdist in dist/, built, checked, and each tried in an environment of its own.
dist:
	PYTHON="$(PYTHON)" CONSTRAINTS="$(CONSTRAINTS)" .ci/dist dist

# Everything that a cluster without a network needs, in one file in dist/ (docs/cluster.md): make bundle EXTRAS=cluster,hdf5
bundle:
	PYTHON="$(PYTHON)" CONSTRAINTS="$(CONSTRAINTS)" packaging/bundle.sh dist "$(EXTRAS)"

# The README's table, measured on this machine in about half an hour; SCENES, DATA and FUNCTIONS: docs/data.md. OUT keeps
# all figures: make figures SCENES=scenes.tsv DATA=data FUNCTIONS=tf
OUT ?= out/figures
figures: $(BIN)/pytest
	PYTHON="$(CURDIR)/$(BIN)/python" benchmarks/figures.sh "$(SCENES)" "$(DATA)" "$(FUNCTIONS)" "$(OUT)"

# The checks that take too long for every change: tests marked `long`, and property tests with 10,000 examples.
long: $(BIN)/pytest
	HYPOTHESIS_PROFILE=long $(BIN)/pytest --long

# 100,000 damaged files for every reader (part of `long`); what is found lies in out/fuzz.
fuzz: $(BIN)/pytest
	$(BIN)/python tests/fuzz.py --inputs 100000 --save out/fuzz

# 200 single-token changes of the package, each of which a test should notice: about an hour on two cores.
mutants: $(BIN)/pytest
	$(BIN)/python tests/mutants.py --number 200

# Files in web viewers (part of `long`): needs Chromium, node and npm; packages go to a cache folder.
viewers: $(BIN)/pytest
	$(BIN)/pytest --long -s -rs tests/test_viewers.py

# The viewer that `vvgt view` serves, anew of the npm packages that page/package.json pins; node and npm are needed.
page:
	vvgt_cli/gaussians/formats/page/build.sh

# The shipped model trained again, data first: out/model/vvgt-small (docs/train.md). An hour of two cores; needs torch:
# its build for CPUs, put into $(VENV) before, spares gigabytes.
PROCESSES ?= $(shell OMP_NUM_THREADS= nproc)
model: $(BIN)/pytest
	$(BIN)/pip install -qq --disable-pip-version-check $(CONSTRAINTS) -e '.[test,train]'
	$(BIN)/python benchmarks/training.py data out/model/data
	PATH="$(CURDIR)/$(BIN):$$PATH" torchrun --standalone --nproc-per-node $(PROCESSES) -m vvgt_cli.commands.main train \
		--data out/model/data --config examples/vvgt-small.yaml -o out/model/run --threads 1
	$(BIN)/vvgt export out/model/run/best.pt -o out/model/vvgt-small --overwrite

ci:
	.ci/run
