# make demo       learn a reward and retrain on it in LunarLander: the whole chain, in minutes
# make test       the tests              make lint   ruff and mypy
# make table1     a table of the paper: missing experts, rewards, retrained policies and returns are
#                 made, then the report. Also figure2 figure3 figure4 table2 experts gates
#                 retraining retraining-ant control control-airl control-airl-5 table1-5 mujoco mujoco-gates
#                 all-results.
#                 `make table1.rewards` stops after a phase: experts, rewards, transfers or returns.
# make report-table1      a report on what exists; runs nothing
# make bench torture clean help
# make bench-peers        training cost beside imitation and stable-baselines3 (docs/cost.md); takes hours
# make test-cluster   the tests that need Slurm: installs it from Debian's packages, as root
#
#   PROFILE=smoke|standard|paper     budgets (settings/)
#   SEEDS="0 1 2"  METHODS="erm irm" instead of those in settings/experiments.toml
#   ROWS=lunar-lander,ant.friction   only these rows, or all rows of an environment
#   SET="--set FIELD=VALUE"          other hyperparameters; needs a TAG
#   CHOOSE="--choose-penalty 1,10"   lambda by leaving a setting out; needs a TAG
#   TAG=NAME                         what the artefacts' names begin with; by default the profile
#                                    (demo, control-airl-5, table1-5: the table's name)
#   JOBS=2                           processes at a time; Slurm's jobs are not limited by it
#   CLUSTER=slurm PARTITION=P TIME=4:00:00 CPUS=1   jobs of a cluster instead (docs/cluster.md)
#   STORE=DIR                        artefact store; by default IRL_STORE or runs
#   FROM=DIR                         store to copy from what it holds, or a URL; FROM= trains everything
#   RESULTS=DIR                      where a report's files go; by default results/TAG/TARGET, with
#                                    the chosen rows, methods and seeds
#
# Every target can be interrupted and run again: what exists is kept, what was interrupted resumes.

PYTHON  ?= python3
VENV    ?= .venv
STORE   ?= $(or $(IRL_STORE),runs)
PROFILE ?= standard
JOBS    ?= 2
FROM    ?= $(wildcard zoo)
# ROWS with commas; the chosen part of a table, sorted as irl does, in names and directories.
COMMA   := ,
LISTED   = $(subst $(eval) ,$(COMMA),$(strip $(ROWS)))
dashed   = $(subst /,-,$(subst $(eval) ,-,$(sort $(subst $(COMMA), ,$(1)))))
PART     = $(addprefix -,$(call dashed,$(ROWS)))$(addprefix -,$(call dashed,$(METHODS)))$(addprefix -seeds-,$(call dashed,$(SEEDS)))
RESULTS ?= results/$(or $(TAG),$(PROFILE))/$@$(PART)

IRL     := $(VENV)/bin/irl
READY   := $(VENV)/.installed
CHOSEN   = --store $(STORE) --profile $(PROFILE) $(addprefix --from ,$(FROM)) $(SET) $(CHOOSE) \
    $(if $(SEEDS),--seeds "$(SEEDS)") $(if $(METHODS),--methods "$(METHODS)") $(addprefix --rows ,$(LISTED))
OPTIONS  = $(CHOSEN) $(if $(filter slurm,$(CLUSTER)),,--jobs $(JOBS)) $(addprefix --tag ,$(TAG)) $(addprefix --cluster ,$(CLUSTER)) \
    $(addprefix --partition ,$(PARTITION)) $(addprefix --time ,$(TIME)) $(addprefix --cpus ,$(CPUS))

.PHONY: help demo test test-cluster lint bench bench-peers torture all-results experts table1 table2 figure2 figure3 figure4
.PHONY: control control-airl control-airl-5 table1-5 gates retraining retraining-ant mujoco mujoco-gates clean
.DELETE_ON_ERROR:
.SECONDARY:

help:
	@sed -n '/^$$/q; s/^# \{0,1\}//p' Makefile

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'installing into $(VENV): some minutes, without further output'
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[test,dev]'
	touch $@

# On two cores: a third worker is at work while other tests wait.
# A file's tests share a worker, so that their fixtures are made once.
test: $(READY)
	$(VENV)/bin/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test-cluster: $(READY)
	command -v slurmctld > /dev/null && command -v sshfs > /dev/null || \
	    apt-get install --yes --no-install-recommends slurm-wlm munge sshfs openssh-sftp-server
	IRL_TEST_CLUSTER=1 $(VENV)/bin/python -m pytest tests/cluster

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# One seed; settings/demo/lunar-lander.toml has the budgets.
demo: $(READY)
	$(IRL) run demo $(OPTIONS) --out $(RESULTS)
	@echo; echo "report: $(RESULTS)/README.md and $(RESULTS)/demo.html"

all-results: experts table1 figure2 figure3 figure4 table2

table1 table1-5 figure3 figure4 gates retraining retraining-ant mujoco mujoco-gates control-airl control-airl-5: %: %.returns
	$(IRL) run $@ $(OPTIONS) --out $(RESULTS)
# Jobs of a cluster are submitted at once: each starts when its inputs exist, not when a phase ends.
%.returns: $(if $(CLUSTER),$(READY),%.transfers)
	$(IRL) run $* $(OPTIONS) --until returns
%.transfers: $(if $(CLUSTER),$(READY),%.rewards)
	$(IRL) run $* $(OPTIONS) --until transfers
%.rewards: $(if $(CLUSTER),$(READY),%.experts)
	$(IRL) run $* $(OPTIONS) --until rewards
%.experts: $(READY)
	$(IRL) run $* $(OPTIONS) --until experts

experts figure2 control: $(READY)
	$(IRL) run $@ $(OPTIONS) --out $(RESULTS)

report-%: $(READY)
	$(IRL) report $* $(CHOSEN) --out $(patsubst %/$@$(PART),%/$*$(PART),$(RESULTS))

# The values of settings/*.toml; needs no store.
table2: $(READY)
	@mkdir -p $(RESULTS)
	$(IRL) report table2 --format latex > $(RESULTS)/table2.tex
	{ printf '# Table 2: interventional settings\n\nID: trained in. OOD: held out.\n\n'; \
	  $(IRL) report table2 --format markdown; } > $(RESULTS)/README.md

bench: $(READY)
	$(VENV)/bin/python -m benchmarks.airl
	$(VENV)/bin/python -m benchmarks.airl --env ant --rounds 2
	$(VENV)/bin/python -m benchmarks.airl --env half-cheetah --rounds 2
	$(VENV)/bin/python -m benchmarks.penalties
	$(VENV)/bin/python -m benchmarks.parallel
	$(VENV)/bin/python -m benchmarks.growth
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m benchmarks.maxent
	$(VENV)/bin/python -m benchmarks.idle
	$(VENV)/bin/python -m benchmarks.workers
	$(VENV)/bin/python -m benchmarks.mujoco_threads
	$(VENV)/bin/python -m benchmarks.data
	$(VENV)/bin/python -m benchmarks.sharing
	$(VENV)/bin/python -m benchmarks.cluster
	@if command -v valgrind > /dev/null; \
	then $(VENV)/bin/python -m benchmarks.startup && $(VENV)/bin/python -m benchmarks.robot_step; \
	else echo "skipped benchmarks.startup and benchmarks.robot_step: they need valgrind"; fi

# An environment of its own for imitation, whose dependencies are older than ours. Finished runs are kept.
PEERS       ?= .venv-peers
PEERS_OUT   ?= docs/results/peers
$(PEERS)/.installed: benchmarks/peers/requirements.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/pip install --quiet --requirement benchmarks/peers/requirements.txt
	touch $@
bench-peers: $(READY) $(PEERS)/.installed
	$(VENV)/bin/python -m benchmarks.peers --jobs $(JOBS) --out $(PEERS_OUT) --peers-python $(PEERS)/bin/python $(ARGS)

# The long form of tests/torture: each theme is a script that prints its figures. Takes over an hour.
TORTURE ?= crash concurrency growth determinism fuzz
torture: $(READY)
	@set -e; for theme in $(TORTURE); do $(VENV)/bin/python tests/torture/$$theme.py; done

clean:
	rm -rf $(VENV) $(PEERS) build
