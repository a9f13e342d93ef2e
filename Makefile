# Two set-up commands: `make demo` and `make test`. Tables: `make table1-lunar-lander`.
#
#   PROFILE=smoke|standard|paper   budgets (settings/)
#   SEEDS="0 1 2"                  seeds of the reward learning
#   STORE=DIR                      artefact store
#   RUN="srun -c2"                 put before every irl command, e.g. to spread over a cluster
#
# Every recipe asks the store for an artefact by name: what is there already costs a moment, what
# was interrupted goes on, so any target can be killed and run again, also with -j.

PYTHON  ?= python3
VENV    ?= .venv
STORE   ?= runs
PROFILE ?= standard
SEEDS   ?= 0 1 2 3 4
METHODS ?= erm erm-balanced irm
RUN     ?=

IRL     := $(VENV)/bin/irl
NAMES   := $(STORE)/.names
COMMON   = --store $(STORE) --profile $(PROFILE)
READY   := $(VENV)/.installed

.DELETE_ON_ERROR:
.PHONY: demo test bench torture table1-lunar-lander figure2 clean FORCE

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[test]'
	touch $@

test: $(READY)
	$(VENV)/bin/python -m pytest -n 2

bench: $(READY)
	$(VENV)/bin/python -m benchmarks.airl
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m benchmarks.maxent
	$(VENV)/bin/python -m benchmarks.startup
	@if command -v valgrind > /dev/null; then $(VENV)/bin/python -m benchmarks.bullet_step; \
	else echo "benchmarks.bullet_step was left out: it counts instructions with valgrind"; fi

# The long form of tests/torture: a script a theme, each prints its figures. Takes an hour or more.
TORTURE ?= crash concurrency growth
torture: $(READY)
	@set -e; for theme in $(TORTURE); do $(VENV)/bin/python tests/torture/$$theme.py; done

# LunarLander with two engine powers to learn from and a third, unseen one to transfer to.
# One seed and about half the standard budget: a look at the whole chain, not a comparison.
DEMO_SETTINGS := --settings settings/demo/lunar-lander.toml
demo: $(READY)
	@$(MAKE) --no-print-directory -j2 TERM=dumb PROFILE=standard SEEDS=0 METHODS="erm irm" \
	    COMMON="--store $(STORE) $(DEMO_SETTINGS)" TAG=demo row-engine-power
	@echo
	@$(IRL) report returns --store $(STORE) $(call EVALUATIONS,demo,engine-power,erm irm,0)
	@echo
	@echo "lineage of the IRM transfer policy (irl lineage demo.engine-power.irm.0.transfer):"
	@$(IRL) lineage --store $(STORE) demo.engine-power.irm.0.transfer

table1-lunar-lander: row-bounce row-engine-power
	$(IRL) report returns --store $(STORE) \
	    $(call EVALUATIONS,$(TAG),bounce,$(METHODS),$(SEEDS)) \
	    $(call EVALUATIONS,$(TAG),engine-power,$(METHODS),$(SEEDS))

# Every method on 20 gridworld datasets: the picture, the table, and how they came about.
# SET="--set gridworld.goal=terminal" and the like make other cases, RESULTS says where they go.
RESULTS ?= docs/results/figure2
FIGURE2   = $(strip report figure2 --profile $(PROFILE) $(SET))
MADE_AT   = import json, sys; a = json.load(sys.stdin); print(a["path"], a["provenance"]["git"]["commit"])
figure2: $(READY)
	$(RUN) $(IRL) $(FIGURE2) --store $(STORE) --name $(TAG).$(@F)
	@mkdir -p $(RESULTS)
	@set -e; set -- $$($(IRL) show --json --store $(STORE) $(TAG).$(@F) \
	    | $(VENV)/bin/python -c '$(MADE_AT)'); \
	  install -m 644 $$1/figure2.png $$1/figure2.pdf $$1/figure2.csv $(RESULTS); \
	  { echo '# Figure 2'; echo; echo "\`irl $(FIGURE2)\`, made at commit $$2."; echo; \
	    echo 'Mean over datasets, and the bootstrap 95 % interval. *Worst trained*: the worst of the'; \
	    echo 'three settings trained on, in each dataset.'; echo; \
	    cat $$1/figure2.md; } > $(RESULTS)/README.md

# A row of the table: experts -> demonstrations -> AIRL per method and seed -> transfer -> returns.
# The held-out values stand in settings/lunar-lander.toml.
TAG ?= $(PROFILE)
RUNS         = $(foreach m,$(3),$(foreach s,$(4),$(1).$(2).$(m).$(s)))
EVALUATIONS  = $(1).$(2).expert-returns $(1).$(2).random-returns $(1).$(2).idle-returns \
               $(addsuffix .zero-shot-returns,$(call RUNS,$(1),$(2),$(3),$(4))) \
               $(addsuffix .transfer-returns,$(call RUNS,$(1),$(2),$(3),$(4)))

define ROW
.PHONY: row-$(1)
row-$(1): $$(addprefix $(NAMES)/,$$(call EVALUATIONS,$(TAG),$(1),$(METHODS),$(SEEDS)))

$(NAMES)/$(TAG).$(1).demos: $(READY) FORCE
	$$(RUN) $(IRL) collect-experts --env lunar-lander --intervention $(1) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).expert-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --expert --env lunar-lander --ood $(1) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).random-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --random --env lunar-lander --ood $(1) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).idle-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --idle --env lunar-lander --ood $(1) $$(COMMON) --name $$(@F)

$$(foreach m,$(METHODS),$$(foreach s,$(SEEDS),$$(eval $$(call CELL,$(1),$$(m),$$(s)))))
endef

# $(1) intervention, $(2) method, $(3) seed
define CELL
$(NAMES)/$(TAG).$(1).$(2).$(3): $(NAMES)/$(TAG).$(1).demos FORCE
	$$(RUN) $(IRL) train-airl --demos $$(<F) --method $(2) --seed $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).$(2).$(3).zero-shot-returns: $(NAMES)/$(TAG).$(1).$(2).$(3) FORCE
	$$(RUN) $(IRL) evaluate --policy $$(<F) --ood $(1) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).$(2).$(3).transfer: $(NAMES)/$(TAG).$(1).$(2).$(3) FORCE
	$$(RUN) $(IRL) transfer --reward $$(<F) --ood $(1) --seed $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).$(2).$(3).transfer-returns: $(NAMES)/$(TAG).$(1).$(2).$(3).transfer FORCE
	$$(RUN) $(IRL) evaluate --policy $$(<F) $$(COMMON) --name $$(@F)
endef

$(foreach row,bounce engine-power,$(eval $(call ROW,$(row))))

FORCE:

clean:
	rm -rf $(VENV) build
