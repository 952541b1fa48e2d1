# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
OUT ?= out
DRAWS ?= 1
export OMP_NUM_THREADS ?= 1

TORCH := $(shell sed -n 's/^\(torch==[^ ]*\).*/\1/p' requirements/torch.txt)
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

.PHONY: demo test test-slow test-share test-all calibrate learn learn-truck truck real paper lint types check wheel docs lock audit clean

# Every package is checked by its hash, and none is built but this one. torch is fetched first, for pip would pass over a
# CPU build that an index offers without saying its hash, and not at all where a build of its version is installed. The
# last line adds the CUDA packages that torch's build names, if it is one that needs them.
$(INSTALLED): pyproject.toml requirements/torch.txt requirements/locked.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "steady-ppl needs Python 3.11 or newer; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) freeze | grep -q "^$(TORCH)" || { \
		$(PIP) download --no-deps --only-binary :all: --dest $(VENV)/torch $(TORCH) && \
		$(PIP) install --no-deps --require-hashes --no-index --find-links $(VENV)/torch -r requirements/torch.txt && \
		rm -r $(VENV)/torch; }
	$(PIP) install --no-deps --require-hashes --only-binary :all: -r requirements/locked.txt
	$(PIP) install --no-build-isolation --editable .
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

real: $(INSTALLED)
	@test -n "$(DATA)" || { echo "make real DATA=FOLDER: the folder with victoria_park/ and mrclam/" >&2; exit 2; }
	$(BIN)/python benchmarks/real.py --cases "$(DATA)" --results $(OUT)/real.jsonl

paper: $(INSTALLED)
	$(BIN)/python benchmarks/paper.py --out $(OUT)/paper $(if $(DATA),--data "$(DATA)") $(if $(QUICK),--quick)

test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal --durations 25

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder -m "slow and not exhaustive" --durations 25

test-all: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder -m "slow or not slow" --durations 25

test-share: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder -m exhaustive --share $(SHARE) --durations 25

calibrate: $(INSTALLED)
	$(BIN)/python benchmarks/calibrate.py $(if $(QUICK),--quick) --results $(OUT)/calibration.jsonl

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

# Benchmarks run by hand and seldom: of their types only names and signatures that are gone are looked for.
LOOSE = arg-type assignment attr-defined call-overload index misc no-untyped-def operator type-arg union-attr unused-ignore var-annotated
types: $(INSTALLED)
	$(BIN)/mypy
	$(BIN)/mypy benchmarks $(LOOSE:%=--disable-error-code=%)

check: lint types test

wheel: $(INSTALLED)
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir $(OUT) .
	@ls $(OUT)/*.whl

docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir $(abspath $(OUT))/site
	@echo "$(OUT)/site/index.html"

# Asks the registry for hashes; versions stay as they are, except those named: make lock UPGRADE="numpy ruff".
lock: $(INSTALLED)
	$(PIP) install uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--custom-compile-command "make lock" $(addprefix --upgrade-package ,$(UPGRADE)) --all-extras \
		--override requirements/no-torch.in --output-file requirements/locked.txt pyproject.toml requirements/torch-needs.in

# Known faults of what is locked. Fails where one is known, and where the service that knows them cannot be asked.
audit:
	$(PYTHON) -m venv $(OUT)/audit
	$(OUT)/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(OUT)/audit/bin/pip-audit --strict --progress-spinner off --disable-pip --no-deps \
		-r requirements/torch.txt -r requirements/locked.txt || \
		{ echo "make audit: not clean: the lines above name a known fault, or say that the service could not be asked" >&2; exit 1; }

clean:
	rm -rf $(VENV) $(OUT)
