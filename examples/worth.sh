#!/usr/bin/env bash
# Measure how much generated training images help for three real cameras, as described in docs/how-to/transfer.md.
#
#   examples/worth.sh PICTURES ARCHIVES OUT [SEEDS]
#
# PICTURES  folder of sRGB photographs, such as BSDS500 and imagenet-sample-images, which are not part of this software
# ARCHIVES  folder with nus_canon_600d_64x64.npz, nus_canon_1ds_mk3_64x64.npz and intel_tau_5dsr_64x64.npz
# OUT       folder for LUTs (3.5 GB each), generated data sets and results; existing results are kept, so that the same
#           command resumes an interrupted measurement
# SEEDS     number of seeds of learners, training images and folds; 5 by default
#
# Environment variables: LEVERS lists the renderings, by default all. NAIVE=no omits the naive rows, which take half of
# the time. LEARNERS lists the methods; log-chroma takes most of the time. REAL=20,100,all adds rows for training with
# these numbers of real images, which come from other parts than the test images.
set -euo pipefail
pictures=$(realpath "$1") archives=$(realpath "$2") out=$3 seeds=${4:-5}
here=$(realpath "$(dirname "$0")")
mkdir -p "$out" && cd "$out"

declare -A archive=([600d]=nus_canon_600d_64x64 [1ds]=nus_canon_1ds_mk3_64x64 [5dsr]=intel_tau_5dsr_64x64)
declare -A part=([600d]=Canon [1ds]=Canon [5dsr]=field)
declare -A sensitivities=([600d]=Canon_EOS_600D [1ds]=Canon_EOS-1Ds_Mark_III [5dsr]=Canon_EOS_5DS)
# Number of parts, each tested once: three for the 5DS R, so that the other two together have 400 images.
declare -A parts=([600d]=2 [1ds]=2 [5dsr]=3)
declare -A matrix=([600d]="Canon EOS 600D" [1ds]="Canon EOS-1Ds Mark III" [5dsr]="Canon EOS 5DS R")
declare -A relit=([600d]=1ds [1ds]=600d [5dsr]=1ds)
learners=${LEARNERS:-regression-trees,kernel-ridge,log-chroma}

once() { # RESULT COMMAND...: run the command if its result does not exist
    [ -e "$1" ] || "${@:2}"
}

for camera in 600d 1ds 5dsr; do
    half=halves/$camera
    once "$half" python "$here/halves.py" "$archives/${archive[$camera]}.npz" "$half" \
        --names "${part[$camera]}" --parts "${parts[$camera]}"
    once "tables/$camera" sim table --camera "${sensitivities[$camera]}" "tables/$camera"
    for ((test = 0; test < parts[$camera]; test++)); do
        colorimetric=(--rendering colorimetric --matrix "${matrix[$camera]}")
        sets=()
        for lever in ${LEVERS:-codes colorimetric compensate random}; do
            case $lever in
                codes) options=(--rendering codes) ;;
                colorimetric) options=("${colorimetric[@]}") ;;
                compensate) options=("${colorimetric[@]}" --black-point compensate) ;;
                random) options=("${colorimetric[@]}" --black-point random) ;;
                *) echo "LEVERS contains $lever, expected codes, colorimetric, compensate or random; correct it" >&2; exit 2 ;;
            esac
            set=sets/$camera$test/$lever
            once "$set" generate "tables/$camera" "$set" --sources "$pictures" --max-side 160 --no-preview \
                --match "$half/others_$test.csv" --seed 1 "${options[@]}"
            sets+=("$set")
        done
        naive=(--naive "$pictures")
        [ "${NAIVE:-yes}" = no ] && naive=()
        once "results/$camera$test" evaluate transfer "$half/half_$test.npz" "${sets[@]}" --seeds "$seeds" \
            --error recovery --method "$learners" "${naive[@]}" \
            --relit "$archives/${archive[${relit[$camera]}]}.npz" ${REAL:+--real "$REAL"} --out "results/$camera$test"
    done
done
