PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
NETCONVERT := $(BIN)/netconvert --offset.disable-normalization true --no-turnarounds true
# Threads of the linear algebra library only cost time here: the matrices are tiny.
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test test-quick lint check faults fuzz format networks docs lock wheel benchmark benchmark-planner reproduce ablation horizon learn figures example clean

demo: $(VENV)/.installed
	$(BIN)/sumo-cohesion compare stalled --seeds 0:8 --out demo
	@echo "The picture is demo/paths.png"

test: $(VENV)/.installed
	$(BIN)/python -m pytest -q --cov --cov-report=term:skip-covered --cov-fail-under=85

# What is quick enough for every save: half a minute.
test-quick: $(VENV)/.installed
	HYPOTHESIS_PROFILE=quick $(BIN)/python -m pytest -q -m "not slow"

lint: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

check: lint test

# Ten thousand random problems and as many random scenes, some minutes; make test tries 400 each.
faults: $(VENV)/.installed
	HYPOTHESIS_PROFILE=thorough $(BIN)/python -m pytest -q tests/unit/test_faults.py tests/unit/test_solvers.py

# Damage inputs and results, each in its own way, and see that every command ends in one clear
# line: some ten minutes. make test tries 200.
N ?= 2000
SEED ?= 0
fuzz: $(VENV)/.installed
	$(BIN)/python -m fuzz -n $(N) --seed $(SEED)

format: $(VENV)/.installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# The comment that netconvert writes holds a date and file paths: leave it out,
# so that the result depends on the sources alone.
networks: $(VENV)/.installed
	cd networks && for n in *.nod.xml; do \
	  b=$${n%.nod.xml}; \
	  ../$(NETCONVERT) -n $$b.nod.xml -e $$b.edg.xml $$(test -f $$b.con.xml && echo -x $$b.con.xml) -o $$b.net.xml && \
	  sed -i '/^<!--/,/^-->/d' $$b.net.xml; done
	cd tests/networks && ../../$(NETCONVERT) -n curve.nod.xml -e curve.edg.xml -x curve.con.xml -o curve.net.xml && \
	  sed -i '/^<!--/,/^-->/d' curve.net.xml

docs: $(VENV)/.installed
	$(BIN)/python -c "from sumo_cohesion.tables.columns import describe_tables as d; print(d(), end='')" > docs/tables.md
	$(BIN)/sumo-cohesion compare stalled_swerve --seeds 0:1 --out results/readme
	cp results/readme/paths.png docs/stalled_swerve.png

lock: $(VENV)/.installed
	$(BIN)/uv pip compile pyproject.toml --extra gui --extra cluster --extra dev --universal --no-annotate --no-header \
	  --no-emit-index-url --no-emit-find-links --python-version 3.11 -o requirements.lock

# The claims and the figures: about 20 minutes on two cores. After a stop it goes on.
reproduce: $(VENV)/.installed
	$(BIN)/python -m analysis.reproduce
	$(BIN)/python -m analysis.markdown
	$(BIN)/python analysis/figures.py

# What each addition to the printed formula is worth: a few minutes.
ablation: $(VENV)/.installed
	$(BIN)/python -m analysis.ablation
	$(BIN)/python -m analysis.markdown

# How far ahead to plan, and on which transitions to be cohesive: ten minutes.
horizon: $(VENV)/.installed
	$(BIN)/python -m analysis.horizon
	$(BIN)/python -m analysis.markdown

# What can be learned of theta, and the claims with it: half an hour. Real humans are CommonRoad
# scenes in a folder: make learn REAL=folder (docs/learning.md says which were used).
REAL ?=
learn: $(VENV)/.installed
	$(BIN)/python -m analysis.learn $(if $(REAL),--real $(REAL))
	$(BIN)/python -m analysis.markdown

figures: $(VENV)/.installed
	$(BIN)/python analysis/figures.py

# The example of docs/batches.md: about ten minutes.
example: $(VENV)/.installed
	$(BIN)/python -m analysis.beta

# Needs do-mpc and rockit: pip install -e '.[benchmark]'.
benchmark-planner: $(VENV)/.installed
	$(BIN)/python -m benchmarks.planner

benchmark: $(VENV)/.installed
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python benchmarks/rooms.py | tee benchmarks/rooms.txt
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m benchmarks.loop | tee benchmarks/loop.txt
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -u -m benchmarks.batch | tee benchmarks/batch.txt
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m benchmarks.fleet | tee benchmarks/fleet.txt

wheel: $(VENV)/.installed
	$(BIN)/python -m build --wheel

$(VENV)/.installed: pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	touch $@

clean:
	rm -rf $(VENV) demo dist build
