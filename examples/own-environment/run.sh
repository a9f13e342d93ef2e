#!/usr/bin/env bash
# The whole chain on the environment of cart.py, which cart.toml describes, and out to other tools.
#
#   examples/own-environment/run.sh [DIRECTORY] [PROFILE] [OPTIONS]
#
# PROFILE is standard (minutes) or smoke (some minutes, most of them to start processes; nothing is learned). DIRECTORY receives the store,
# a dataset of Minari and the report. OPTIONS are those of irl run, for example --seeds 0.
set -euo pipefail
out=$(realpath "${1:-cart-results}")
profile=${2:-standard}
irl=${IRL:-irl}
python=${PYTHON:-python3}
cd "$(dirname "$0")"
export IRL_STORE=$out/runs MINARI_DATASETS_PATH=$out/minari

$irl envs check cart.toml

# Step by step: only the first command needs the file, the others read it from the artefacts.
$irl collect-experts --env cart.toml --intervention mass=1x,2x --name demos --profile "$profile"
$irl train-airl --demos demos --method irm --name irm --profile "$profile"
$irl transfer --reward irm --ood 4x --name moved --profile "$profile"
$irl evaluate --policy moved --profile "$profile"
$irl evaluate --policy moved --setting mass=4x,drag=1 --profile "$profile"

# Demonstrations to Minari and back. What comes back is equal: its export has the same bytes.
$irl export demos demos --to minari:me/cart-v0
$irl import minari:me/cart-v0 --env cart.toml --intervention mass=1x,2x --name back
for name in demos back; do $irl export demos "$name" --to "parquet:$out/$name.parquet"; done
cmp "$out/demos.parquet" "$out/back.parquet"

# The learned reward trains SAC of stable-baselines3.
steps=10000; [ "$profile" = smoke ] && steps=200
$python sac.py irm "$steps"

# A colleague gets the policy and all that it was made from, and measures the same returns. Here the
# place is a directory; it may be a URL such as s3://BUCKET/PATH.
$irl push moved --to "$out/shared"
$irl pull moved --from "$out/shared" --store "$out/colleague"
$irl verify --store "$out/colleague"
own=$($irl evaluate --policy moved --profile "$profile")
theirs=$($irl evaluate --policy moved --profile "$profile" --store "$out/colleague")
test "$(basename "$own")" = "$(basename "$theirs")"

# Or all at once, with a report: two methods, two seeds. What exists is used.
$irl run cart --experiments tables.toml --profile "$profile" --jobs 2 --out "$out/report" "${@:3}"
