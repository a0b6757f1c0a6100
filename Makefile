PYTHON ?= python3
BIN := .venv/bin
# Kept, whatever the environment says: each process of a run would compile all sources again.
unexport PYTHONDONTWRITEBYTECODE

# Tests that call all rooms, for `make types`; another set: make types TYPED=tests/test_weak.py
TYPED := $(patsubst %,tests/test_%.py,types files numbers fields inspection kalman \
	propellants axial plane thruster model simulation forecast datasets weak constraints search systems given \
	control_law refine operating_plots map_plots plots sklearn report compare experiment_benchmark)

.PHONY: breathing thesis test test-fast test-slow test-lowest test-docs lint types docs docs-numbers benchmark clean

# The stamp is written last: an interrupted installation is taken up again.
.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt torch
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	$(BIN)/ep2sindy precompile
	touch $@

breathing: .venv/installed
	$(BIN)/python -m experiments.run +exp=breathing

# The thesis's experiments, on a folder of its data: docs/thesis.md. make thesis FOLDER=runs DATA=mine
FOLDER ?= runs
DATA ?= hyphen
SPT100 = data=$(DATA) trajectory.zone.z=downstream 'trajectory.zone.r=[0.035,0.05]' \
	'prepare=[{_target_:ep2sindy.thruster.ionization_rate}]' $(MORE)
thesis: .venv/installed
	$(BIN)/python -m experiments.run -m +exp=breathing,weak,ils,constrained,pointwise \
		data.path='$(FOLDER)/V300_m5.*' $(SPT100)
	$(BIN)/python -m experiments.run +exp=parametric \
		points.files='$(FOLDER)/V{V_D_V}_m{mdot_mg_s}.*' $(SPT100)

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Shapes and types of every call are checked by jaxtyping's hook, here and nowhere else.
types: .venv/installed
	$(BIN)/python -m pytest -q -m "not slow" -p tests.checked $(TYPED)

test: lint test-fast

test-fast: .venv/installed
	$(BIN)/python -m pytest -q -m "not slow" -n auto --dist worksteal

# EP2SINDY_DATA=folder adds the checks against files that are not shipped.
test-slow: lint
	$(BIN)/python -m pytest -q

# The fast suite with the lowest versions that pyproject.toml admits; of torch the tested one.
test-lowest:
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet -c constraints.txt torch uv
	grep '^torch==' constraints.txt > .venv-lowest/torch.txt
	.venv-lowest/bin/uv pip install --python .venv-lowest/bin/python --resolution lowest-direct \
		--override .venv-lowest/torch.txt -e ".[dev]"
	.venv-lowest/bin/python -m pytest -q -m "not slow" -n auto --dist worksteal

# What guards figures and commands of README and docs: every page's Python, the site, the wheel.
test-docs: .venv/installed
	$(BIN)/python -m pytest -q tests/test_docs.py tests/test_site.py tests/test_wheel.py

# The site, into ./site; a warning is an error. Its notebook is run on the way.
docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

# Writes into the pages what their code and commands print now, and the numbers of their runs; look
# at the difference before you commit it. One page: make docs-numbers PAGES=docs/odes.md
docs-numbers: .venv/installed
	$(BIN)/python -m tests.rerun $(PAGES)

benchmark: .venv/installed
	$(BIN)/python -m benchmarks.search
	$(BIN)/python -m benchmarks.simulator_2d
	$(BIN)/python -m benchmarks.source
	$(BIN)/python -m benchmarks.hallthruster
	$(BIN)/python -m benchmarks.refine
	$(BIN)/python -m benchmarks.many_states
	$(BIN)/python -m benchmarks.intervals
	$(BIN)/python -m benchmarks.pointwise
	$(BIN)/python -m benchmarks.regimes
	$(BIN)/python -m benchmarks.points family

clean:
	rm -rf .venv .venv-lowest site .cache .mypy_cache .ruff_cache .pytest_cache
