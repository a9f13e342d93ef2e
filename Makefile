# Two set-up commands: `make demo` and `make test`. Results: `make experts table1 figure2 figure3
# figure4 table2`, or `make all-results`; `make report-table1` reports on what is there and runs
# nothing.
#
#   PROFILE=smoke|standard|paper   budgets (settings/)
#   SEEDS="0 1 2"                  seeds of the reward learning
#   METHODS="erm irm"              of erm, irm, erm-balanced, irm-shuffled
#   SET="--set FIELD=VALUE"        more settings, for every command
#   CHOOSE="--choose-penalty 1,10" lambda of the penalised methods by leaving a setting out
#   TAG=mine                       what the runs' names begin with: the profile, and with SET or
#                                  CHOOSE yours to say, so that no run takes another's name
#   RESULTS=DIR                    where a report's files go, by default results/TAG/TARGET;
#                                  what is published is RESULTS=docs/results/TARGET
#   STORE=DIR                      artefact store, by default IRL_STORE, else runs
#   RUN="srun -c2"                 put before every irl command, e.g. to spread over a cluster
#
# Every recipe asks the store for an artefact by name: what is there already costs a moment, what
# was interrupted goes on, so any target can be killed and run again, also with -j.

PYTHON  ?= python3
VENV    ?= .venv
STORE   ?= $(or $(IRL_STORE),runs)
PROFILE ?= standard
SEEDS   ?= 0 1 2 3 4
METHODS ?= erm irm erm-balanced irm-shuffled
RUN     ?=

IRL     := $(VENV)/bin/irl
NAMES   := $(STORE)/.names
COMMON   = --store $(STORE) --profile $(PROFILE) $(SET)
READY   := $(VENV)/.installed

ifneq ($(strip $(SET)$(CHOOSE)),)
ifndef TAG
$(error SET and CHOOSE make other runs: say what to call them, e.g. TAG=mine)
endif
endif
TAG ?= $(PROFILE)
ifneq ($(words $(TAG)),1)
$(error TAG="$(TAG)": write one word, which the names of all runs begin with)
endif

KNOWN   := erm irm erm-balanced irm-shuffled
METHODS := $(strip $(METHODS))
SEEDS   := $(strip $(SEEDS))
ifneq ($(words $(METHODS)),$(words $(sort $(filter $(KNOWN),$(METHODS)))))
$(error METHODS="$(METHODS)": write some of $(KNOWN), each once, with spaces between them)
endif
DIGITS  := 0 1 2 3 4 5 6 7 8 9
without  = $(if $(2),$(call without,$(subst $(firstword $(2)),,$(1)),$(wordlist 2,10,$(2))),$(1))
ifneq ($(strip $(call without,$(SEEDS),$(DIGITS))),)
$(error SEEDS="$(SEEDS)": write numbers with spaces between them, SEEDS="0 1 2")
endif
ifneq ($(filter 0%,$(filter-out 0,$(SEEDS))),)
$(error SEEDS="$(SEEDS)": write numbers without zeros before them, SEEDS="0 1 2")
endif
ifneq ($(words $(SEEDS)),$(words $(sort $(SEEDS))))
$(error SEEDS="$(SEEDS)": write each seed once, with spaces between them)
endif
ifeq ($(and $(METHODS),$(SEEDS)),)
$(error METHODS="$(METHODS)" SEEDS="$(SEEDS)": write at least one of each, with spaces between them)
endif

.DELETE_ON_ERROR:
.PHONY: demo test bench torture all-results experts table1 table1-lunar-lander table2 figure2 figure3 figure4 clean FORCE

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[test]'
	touch $@

test: $(READY)
	$(VENV)/bin/python -m pytest -n 2

bench: $(READY)
	$(VENV)/bin/python -m benchmarks.airl
	$(VENV)/bin/python -m benchmarks.airl --env ant --rounds 2
	$(VENV)/bin/python -m benchmarks.parallel
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m benchmarks.maxent
	$(VENV)/bin/python -m benchmarks.startup
	$(VENV)/bin/python -m benchmarks.workers
	@if command -v valgrind > /dev/null; then $(VENV)/bin/python -m benchmarks.bullet_step; \
	else echo "benchmarks.bullet_step was left out: it counts instructions with valgrind"; fi

# The long form of tests/torture: a script a theme, each prints its figures. Takes an hour or more.
TORTURE ?= crash concurrency growth determinism fuzz
torture: $(READY)
	@set -e; for theme in $(TORTURE); do $(VENV)/bin/python tests/torture/$$theme.py; done

# LunarLander with two engine powers to learn from and a third, unseen one to transfer to.
# One seed and about half the standard budget: a look at the whole chain, not a comparison.
DEMO_SETTINGS := --settings settings/demo/lunar-lander.toml
DEMO_ROW := lunar-lander.engine-power
demo: $(READY)
	@$(MAKE) --no-print-directory -j2 TERM=dumb PROFILE=standard SEEDS=0 METHODS="erm irm" \
	    COMMON="--store $(STORE) $(DEMO_SETTINGS)" TAG=demo \
	    $(DEMO_ROW).returns
	@echo
	@$(IRL) report returns --store $(STORE) $(call RETURNS,demo.$(DEMO_ROW),erm irm,0)
	@echo
	@echo "what it earns to learn no reward (irl evaluate --expert --trained-in engine-power ...):"
	@$(IRL) evaluate --expert --trained-in engine-power --env lunar-lander --ood engine-power \
	    --store $(STORE) $(DEMO_SETTINGS) --quiet > /dev/null
	@echo
	@echo "lineage of the IRM transfer policy (irl lineage demo.$(DEMO_ROW).irm.0.transfer):"
	@$(IRL) lineage --store $(STORE) demo.$(DEMO_ROW).irm.0.transfer

# The paper's tables and figures: rows of ENV.KNOB, whose settings stand in settings/ENV.toml.
TABLE1  := lunar-lander.bounce lunar-lander.engine-power ant.friction ant.leg-length
FIGURE3 := ant.leg-length half-cheetah.friction reacher.gravity
FIGURE4 := ant.goal-y half-cheetah.goal-y

# The expert of every setting, and what the random and the idle agent earn there.
EXPERTS := $(addprefix lunar-lander.,bounce friction engine-power) \
    $(addprefix ant.,mass friction leg-length goal-y direction) \
    $(addprefix half-cheetah.,mass friction leg-length goal-y direction) reacher.gravity

all-results: experts table1 figure2 figure3 figure4 table2

experts: $(addsuffix .experts,$(EXPERTS))
	$(REPORT_EXPERTS)
table1: $(addsuffix .returns,$(TABLE1)) $(addsuffix .id-returns,$(TABLE1))
	$(REPORT)
table1-lunar-lander: $(foreach row,$(filter lunar-lander.%,$(TABLE1)),$(row).returns $(row).id-returns)
	$(REPORT)
figure3: $(addsuffix .zero-shot-returns,$(FIGURE3)) $(addsuffix .id-returns,$(FIGURE3))
	$(REPORT)
figure4: $(addsuffix .zero-shot-returns,$(FIGURE4)) $(addsuffix .id-returns,$(FIGURE4))
	$(REPORT)

# What is there, without running anything.
REPORTS := $(addprefix report-,table1 table1-lunar-lander figure3 figure4)
.PHONY: $(REPORTS)
$(REPORTS): $(READY)
	$(REPORT)

.PHONY: report-experts
report-experts: $(READY)
	$(REPORT_EXPERTS)

define REPORT_EXPERTS
@set -e; made=$$($(RUN) $(IRL) report experts $(COMMON) --name $(TAG).experts); \
  mkdir -p $(RESULTS); \
  install -m 644 $$made/README.md $$made/experts.csv $$made/experts.png $(RESULTS)
endef

# Of the target's name: the report (what follows a dash is an environment), and where its files go.
WHAT    = $(patsubst report-%,%,$@)
KIND    = $(firstword $(subst -, ,$(WHAT)))
ENV     = $(patsubst $(KIND)-%,--env %,$(filter $(KIND)-%,$(WHAT)))
COMMA  := ,
SPACE  := $(subst ,, )
LIST    = $(subst $(SPACE),$(COMMA),$(strip $(1)))
RESULTS ?= results/$(TAG)/$(WHAT)

define REPORT
@set -e; made=$$($(RUN) $(IRL) report $(KIND) $(COMMON) $(CHOOSE) $(ENV) --seeds $(call LIST,$(SEEDS)) \
    --methods $(call LIST,$(METHODS)) --name $(TAG).$(WHAT)); \
  mkdir -p $(RESULTS); \
  install -m 644 $$made/README.md $$made/$(KIND).* $$made/seeds.csv $$made/comparisons.csv $(RESULTS)
endef

table2: $(READY)
	@mkdir -p $(RESULTS)
	$(IRL) report table2 --format latex > $(RESULTS)/table2.tex
	{ echo '# Table 2: interventional settings'; echo; \
	  echo 'The values of `settings/*.toml`, by `irl report table2 --format markdown`. ID: trained'; \
	  echo 'in; OOD: held out.'; echo; \
	  $(IRL) report table2 --format markdown; } > $(RESULTS)/README.md

# Every method on 20 gridworld datasets: the picture, the table, and how they came about.
# SET="--set gridworld.goal=terminal" and the like make other cases, RESULTS says where they go.
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

# A row: experts -> demonstrations -> AIRL per method and seed -> transfer -> returns. Its targets
# are names in the store; ROW.returns and the like are those of a row together.
RUNS    = $(foreach m,$(2),$(foreach s,$(3),$(1).$(m).$(s)))
AGENTS  = $(addprefix $(1),.expert-returns .random-returns .idle-returns)
ZERO    = $(call AGENTS,$(1)) $(addsuffix .zero-shot-returns,$(call RUNS,$(1),$(2),$(3)))
RETURNS = $(call ZERO,$(1),$(2),$(3)) $(foreach run,$(call RUNS,$(1),$(2),$(3)),\
    $(run).transfer-returns $(run).expert-by-reward)
CELLS   = $(addprefix $(NAMES)/,$(call $(1),$(TAG).$(2),$(METHODS),$(SEEDS)))

# $(1) ENV.KNOB, $(2) ENV, $(3) KNOB
define ROW
.PHONY: $(addprefix $(1).,returns zero-shot-returns id-returns expert-id-returns carried-returns)
$(1).returns: $(1).carried-returns $$(call CELLS,RETURNS,$(1))
$(1).zero-shot-returns: $(1).carried-returns $$(call CELLS,ZERO,$(1))
$(1).id-returns: $(1).expert-id-returns $$(addsuffix .id-returns,$$(call CELLS,RUNS,$(1)))

$(NAMES)/$(TAG).$(1).demos: $(READY) FORCE
	$$(RUN) $(IRL) collect-experts --env $(2) --intervention $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).expert-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --expert --env $(2) --ood $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).random-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --random --env $(2) --ood $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(TAG).$(1).idle-returns: $(READY) FORCE
	$$(RUN) $(IRL) evaluate --idle --env $(2) --ood $(3) $$(COMMON) --name $$(@F)

# An evaluation for each setting, too many for one name. The report's name keeps them from gc.
$(1).expert-id-returns: $(NAMES)/$(TAG).$(1).demos
	$$(RUN) $(IRL) evaluate --expert --env $(2) --intervention $(3) $$(COMMON)

# The experts trained in, in the other settings: what it earns to learn no reward.
$(1).carried-returns: $(NAMES)/$(TAG).$(1).demos
	$$(RUN) $(IRL) evaluate --expert --trained-in $(3) --env $(2) --ood $(3) $$(COMMON)
	$$(RUN) $(IRL) evaluate --expert --trained-in $(3) --env $(2) --intervention $(3) $$(COMMON)

$$(foreach m,$(METHODS),$$(foreach s,$(SEEDS),$$(eval $$(call CELL,$(TAG).$(1).$$(m).$$(s),$(TAG).$(1),$(3),$$(m),$$(s)))))
endef

# $(1) ENV.KNOB, $(2) ENV, $(3) KNOB
define EXPERTS_OF
.PHONY: $(1).experts
$(1).experts: $(READY)
	$$(RUN) $(IRL) evaluate --expert --env $(2) --intervention $(3) $$(COMMON)
	$$(RUN) $(IRL) evaluate --expert --env $(2) --ood $(3) $$(COMMON)
	@for agent in random idle; do for use in intervention ood; do \
	    $$(RUN) $(IRL) evaluate --$$$$agent --env $(2) --$$$$use $(3) $$(COMMON) || exit; done; done
endef

# $(1) name, $(2) name of the row, $(3) KNOB, $(4) method, $(5) seed
define CELL
$(NAMES)/$(1): $(NAMES)/$(2).demos FORCE
	$$(RUN) $(IRL) train-airl --demos $$(<F) --method $(4) --seed $(5) $(if $(filter irm%,$(4)),$$(CHOOSE)) \
	    $$(COMMON) --name $$(@F)

$(NAMES)/$(1).zero-shot-returns: $(NAMES)/$(1) FORCE
	$$(RUN) $(IRL) evaluate --policy $$(<F) --ood $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(1).id-returns: $(NAMES)/$(1) FORCE
	$$(RUN) $(IRL) evaluate --policy $$(<F) --intervention $(3) $$(COMMON) --name $$(@F)

$(NAMES)/$(1).transfer: $(NAMES)/$(1) FORCE
	$$(RUN) $(IRL) transfer --reward $$(<F) --ood $(3) --seed $(5) $$(COMMON) --name $$(@F)

# What the reward pays the policy that was trained on it, and what it would pay the expert there.
$(NAMES)/$(1).transfer-returns: $(NAMES)/$(1).transfer FORCE
	$$(RUN) $(IRL) evaluate --policy $$(<F) --reward $(1) $$(COMMON) --name $$(@F)

$(NAMES)/$(1).expert-by-reward: $(NAMES)/$(1) FORCE
	$$(RUN) $(IRL) evaluate --expert --ood $(3) --reward $$(<F) $$(COMMON) --name $$(@F)
endef

$(foreach row,$(sort $(TABLE1) $(FIGURE3) $(FIGURE4)),$(eval \
    $(call ROW,$(row),$(firstword $(subst ., ,$(row))),$(lastword $(subst ., ,$(row))))))

$(foreach row,$(EXPERTS),$(eval \
    $(call EXPERTS_OF,$(row),$(firstword $(subst ., ,$(row))),$(lastword $(subst ., ,$(row))))))

FORCE:

clean:
	rm -rf $(VENV) build
