#!/usr/bin/env bash
# Pretrain, train, measure and pack weights on a machine that has only Python with torch, numpy, pyarrow and safetensors:
# no simulator, no network, no installation. Run it again after an interruption: it resumes.
#
#   BUNDLE      training bundle (dro-grasp dataset bundle ... --split train)
#   VALIDATION  bundle of the validate split, on which distance errors are reported
#   OUT         folder for the results: weights in pieces of 15 MB, checksum, logs
#   RUNS        folder for checkpoints, which stay on the machine                 (runs)
#   WHEELS      folder of wheels to install first, listed in docs/training.md    (none)
#   PROCESSES   training processes, one for each GPU                              (1)
#   PRETRAIN    options of `pretrain`                                             (--minutes 3)
#   TRAIN       options of `train`                                                (--minutes 6)
#   NAME        name of the weights                                               (multi)
set -euo pipefail
: "${BUNDLE:?}" "${VALIDATION:?}" "${OUT:?}"
RUNS=${RUNS:-runs} PROCESSES=${PROCESSES:-1} NAME=${NAME:-multi}
PRETRAIN=${PRETRAIN:---minutes 3} TRAIN=${TRAIN:---minutes 6}
export PYTHONPATH="$(cd "$(dirname "$0")/.." && pwd)/src${PYTHONPATH:+:$PYTHONPATH}"
mkdir -p "$RUNS" "$OUT"

if [ -n "${WHEELS:-}" ]; then
    python3 -m pip install --quiet --no-index --no-deps --target "$RUNS/packages" "$WHEELS"/*.whl
    export PYTHONPATH="$PYTHONPATH:$RUNS/packages"
fi

launch() { python3 -m torch.distributed.run --standalone --nproc-per-node "$PROCESSES" -m dro_grasp "$@"; }

# shellcheck disable=SC2086  # options are several words
launch pretrain --bundle "$BUNDLE" --run-folder "$RUNS/pretrain" --output "$RUNS/pretrained.safetensors" \
    --shards "$PROCESSES" $PRETRAIN
# shellcheck disable=SC2086
launch train --bundle "$BUNDLE" --validation "$VALIDATION" --pretrained "$RUNS/pretrained.safetensors" \
    --run-folder "$RUNS/train" --output "$RUNS/$NAME.safetensors" --shards "$PROCESSES" $TRAIN | tee "$OUT/train.txt"

split --bytes=15MB --numeric-suffixes "$RUNS/$NAME.safetensors" "$OUT/$NAME.safetensors."
(cd "$RUNS" && sha256sum "$NAME.safetensors") > "$OUT/$NAME.sha256"
cp "$RUNS/train/log.jsonl" "$OUT/log.jsonl"
echo "join the pieces: cat $NAME.safetensors.* > $NAME.safetensors && sha256sum --check $NAME.sha256"
