# make test | quick | lint | formats | docs | long | mutants | viewers | page | model | ci
VENV ?= .venv-test
PYTHON ?= python3

.PHONY: test quick lint format formats docs long fuzz mutants viewers page model ci

$(VENV)/bin/pytest: pyproject.toml constraints.txt
	[ -x $(VENV)/bin/python ] || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

test: $(VENV)/bin/pytest
	$(VENV)/bin/pytest -n 2 --dist loadfile

# While working, for less than a minute once kernels are compiled: the order of subpackages, pages, cameras, pictures, metrics, the
# splatter and the ray caster's scenes, transfer functions, most formats; ten examples a property, no conversions.
QUICK := architecture docs_pages cameras_blocks cameras_files images_compose images_files metrics_images \
	metrics_scores gaussians_ply optimize_loss splat_render dvr_scene look_readers look_resolve volume_affines \
	volume_headers volume_itk volume_raw volume_registry volume_tiff
quick: $(VENV)/bin/pytest
	HYPOTHESIS_PROFILE=quick $(VENV)/bin/pytest -n 2 --dist loadfile $(QUICK:%=tests/test_%.py)

lint: $(VENV)/bin/pytest
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

format: $(VENV)/bin/pytest
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

# Endings of files in modules of other programs, which cannot read our table of formats.
formats: $(VENV)/bin/pytest
	$(VENV)/bin/python -m tests.endings

# The documentation as a site that can be searched: out/docs/index.html.
docs: $(VENV)/bin/pytest
	$(VENV)/bin/pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test,docs]'
	$(VENV)/bin/python -m sphinx -W --keep-going -q -c docs . out/docs

# The checks that take too long for every change: tests marked `long`, and property tests with 10,000 examples.
long: $(VENV)/bin/pytest
	HYPOTHESIS_PROFILE=long $(VENV)/bin/pytest --long

# 100,000 damaged files for every reader (part of `long`); what is found lies in out/fuzz.
fuzz: $(VENV)/bin/pytest
	$(VENV)/bin/python tests/fuzz.py --inputs 100000 --save out/fuzz

# 200 single-token changes of the package, each of which a test should notice: about an hour on two cores.
mutants: $(VENV)/bin/pytest
	$(VENV)/bin/python tests/mutants.py --number 200

# Files in web viewers (part of `long`): needs Chromium, node and npm; packages go to a cache folder.
viewers: $(VENV)/bin/pytest
	$(VENV)/bin/pytest --long -s -rs tests/test_viewers.py

# The viewer that `vvgt view` serves, anew of the npm packages that page/package.json pins; node and npm are needed.
page:
	vvgt_cli/gaussians/formats/page/build.sh

# The shipped model trained again, data first: out/model/vvgt-small (docs/train.md). An hour of two cores; needs torch:
# its build for CPUs, put into $(VENV) before, spares gigabytes.
PROCESSES ?= $(shell OMP_NUM_THREADS= nproc)
model: $(VENV)/bin/pytest
	$(VENV)/bin/pip install -qq --disable-pip-version-check -c constraints.txt -e '.[test,train]'
	$(VENV)/bin/python benchmarks/training.py data out/model/data
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" torchrun --standalone --nproc-per-node $(PROCESSES) -m vvgt_cli.commands.main train \
		--data out/model/data --config examples/vvgt-small.yaml -o out/model/run --threads 1
	$(VENV)/bin/vvgt export out/model/run/best.pt -o out/model/vvgt-small --overwrite

ci:
	.ci/run
