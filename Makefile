# Two commands do everything on a fresh machine with Python >= 3.11: `make ablate` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: ablate test slurm lint readme clean

ablate: $(VENV)/installed
	$(BIN)/mtl-bench ablate --grid backbones

# One file of tests a core, those of whole runs first; more threads than cores would wait for each other
test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# For the tests of clusters, on Debian as root; where it cannot be had they are skipped and say so
slurm:
	-command -v slurmctld || { apt-get -q update && \
		DEBIAN_FRONTEND=noninteractive apt-get -q install -y --no-install-recommends slurmctld slurmd slurm-client; }

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

readme: $(VENV)/installed
	$(BIN)/python -m mtl_bench.report.readme README.md reports

$(VENV)/installed: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) build dist
