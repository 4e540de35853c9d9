#!/usr/bin/env bash
# What training on generated images is worth on three real cameras: the figures of docs/transfer.md.
#
#   examples/worth.sh PICTURES ARCHIVES OUT [SEEDS]
#
# PICTURES  a folder of sRGB photographs: there BSDS500 (500) and 1000 of ImageNet (imagenet-sample-images), which you fetch
#           yourself and which are not part of this software.
# ARCHIVES  a folder with nus_canon_600d_64x64.npz, nus_canon_1ds_mk3_64x64.npz and intel_tau_5dsr_64x64.npz.
# OUT       tables (3.5 GB each), generated sets and results; what is there already is kept, so the script goes on where it was.
# SEEDS     of learners, training images and folds, by default 5.
#
# RENDERINGS (environment) chooses levers of `levers` below; by default all.
set -euo pipefail
pictures=$(realpath "$1") archives=$(realpath "$2") out=$3 seeds=${4:-5}
here=$(realpath "$(dirname "$0")")
mkdir -p "$out" && cd "$out"

declare -A archive=([600d]=nus_canon_600d_64x64 [1ds]=nus_canon_1ds_mk3_64x64 [5dsr]=intel_tau_5dsr_64x64)
declare -A sensitivities=([600d]=Canon_EOS_600D [1ds]=Canon_EOS-1Ds_Mark_III [5dsr]=Canon_EOS_5DS)
declare -A matrix=([600d]="Canon EOS 600D" [1ds]="Canon EOS-1Ds Mark III" [5dsr]="Canon EOS 5DS R")
declare -A levers=(
    [codes]="--rendering codes"
    [colorimetric]="--rendering colorimetric"
    [compensate]="--rendering colorimetric --black-point compensate"
    [random]="--rendering colorimetric --black-point random"
)

once() { # RESULT COMMAND...: run the command unless its result is there
    [ -e "$1" ] || "${@:2}"
}

for camera in 600d 1ds 5dsr; do
    once "halves/$camera" python "$here/halves.py" "$archives/${archive[$camera]}.npz" "halves/$camera" --names \
        "$([ $camera = 5dsr ] && echo field || echo Canon)"
    once "tables/$camera" sim table --camera "${sensitivities[$camera]}" "tables/$camera"
    for half in 0 1; do
        sets=()
        for lever in ${RENDERINGS:-codes colorimetric compensate random}; do
            set=sets/$camera$half/$lever
            # shellcheck disable=SC2086  # options are words
            once "$set" generate "tables/$camera" "$set" --sources "$pictures" --max-side 160 --no-previews \
                --match "halves/$camera/lights_$((1 - half)).csv" --outside nearest --seed 1 ${levers[$lever]}
            sets+=(--train "$set")
        done
        common=(--test "halves/$camera/${archive[$camera]}.npz" --only "halves/$camera/images_$half.csv" --side 64
            --images 900 --seeds "$seeds" --error recovery --statistics none
            --methods regression-trees,kernel-ridge,log-chroma)
        once "results/$camera$half" evaluate transfer "${sets[@]}" "${common[@]}" --naive "$pictures" \
            --matrix "${matrix[$camera]}" --out "results/$camera$half"
    done
done
once pool evaluate pool results/* --out pool
