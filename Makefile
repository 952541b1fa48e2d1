# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
OUT ?= out
DRAWS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: demo test found learn learn-truck truck paper lint types check wheel docs clean

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "steady-ppl needs Python 3.11 or newer; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/steady demo --out $(OUT)/demo

learn: $(INSTALLED)
	$(BIN)/python benchmarks/learn.py hov --out $(OUT)/learn

learn-truck: $(INSTALLED)
	@test -n "$(DATA)" || { echo "make learn-truck DATA=FOLDER: the folder with train/, valid/ and test/ of the AlphaTruck logs" >&2; exit 2; }
	$(BIN)/python benchmarks/learn.py truck --data "$(DATA)" --out $(OUT)/learn-truck

truck: $(INSTALLED)
	@test -n "$(DATA)" || { echo "make truck DATA=FOLDER: the folder with train/, valid/ and test/ of the AlphaTruck logs" >&2; exit 2; }
	$(BIN)/python benchmarks/truck.py --data "$(DATA)" --draws $(DRAWS) --out $(OUT)/truck

paper: $(INSTALLED)
	$(BIN)/python benchmarks/paper.py --out $(OUT)/paper $(if $(DATA),--data "$(DATA)") $(if $(QUICK),--quick)

test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

found: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/mypy

check: lint types test

wheel: $(INSTALLED)
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir $(OUT) .
	@ls $(OUT)/*.whl

docs: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir $(abspath $(OUT))/site
	@echo "$(OUT)/site/index.html"

clean:
	rm -rf $(VENV) $(OUT)
