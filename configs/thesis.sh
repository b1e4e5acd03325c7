#!/usr/bin/env bash
# The thesis from data to tables: trainings first, which take days on a GPU, then tables.
#   bash configs/thesis.sh kitti KITTI OUT                      chapter 2, tables in OUT/depth
#   bash configs/thesis.sh linemod Linemod_preprocessed OUT     chapter 3, tables in OUT/pose
# Started again it leaves out finished trainings and resumes a stopped one. DEVICE=cuda: tables on a
# GPU; trainings take the one that is there. SPLIT and PROTOCOL: of the tables of chapter 2.
# CONFIGS: another folder of configs.
set -euo pipefail
[ $# = 3 ] || { sed -n '2,7s/^# //p' "$0" >&2; exit 2; }
chapter=$1 data=$2 out=$3
configs=${CONFIGS:-$(dirname "$0")} device=${DEVICE:-cpu}

[ -d "$configs" ] || { echo "$configs: no folder of configs" >&2; exit 2; }
say() { echo "depthpose $*" >&2; depthpose "$@"; }
train() { [ -f "$1" ] || say "${@:2}" --data "$data" --resume; }

case $chapter in
kitti)
  home=$out/depth
  generator=$home/view/generator.safetensors matcher=$home/stereo/matcher.safetensors
  apart=$home/apart.safetensors finetuned=$home/finetune/fakestereo.safetensors
  train "$generator" depth train view --out "$home/view" --config "$configs/depth/view.yaml"
  train "$matcher" depth train stereo --out "$home/stereo" --config "$configs/depth/stereo.yaml"
  [ -f "$apart" ] || say weights pack "$generator" --matcher "$matcher" --out "$apart" \
    --trained-on "KITTI raw" --licence "not stated; that of KITTI binds"
  train "$finetuned" depth train finetune --generator "$generator" --matcher "$matcher" \
    --out "$home/finetune" --config "$configs/depth/finetune.yaml"
  how=(--kitti "$data" --split "${SPLIT:-eigen-test}" --protocol "${PROTOCOL:-eigen-raw}"
       --device "$device")
  say reproduce 2.1 "${how[@]}" --weights "$apart" --out "$home/table-2.1"
  say reproduce 2.2 "${how[@]}" --weights "$matcher" --out "$home/table-2.2"
  say reproduce 2.3 "${how[@]}" --weights "$apart" "$finetuned" --out "$home/table-2.3"
  ;;
linemod)
  home=$out/pose
  weights() { echo "$home/$1/$1.safetensors"; }
  for what in pose pointnet depth-image segmentation; do
    case $what in pose) config=thesis ;; segmentation) config=thesis-masks ;; *) config=thesis-$what ;; esac
    train "$(weights $what)" pose train --what $what --out "$home/$what" \
      --config "$configs/pose/$config.yaml"
  done
  how=(--linemod "$data" --no-icp --masks truth "$(weights segmentation)" --device "$device")
  say reproduce 3.1 "${how[@]}" --out "$home/table-3.1" \
    --weights "$(weights pose)" "$(weights pointnet)" "$(weights depth-image)"
  say reproduce 3.2 "${how[@]}" --weights "$(weights pose)" --out "$home/table-3.2"
  say reproduce 3.3 --linemod "$data" --weights "$(weights pose)" --out "$home/table-3.3"
  ;;
*)
  echo "chapters are kitti and linemod, not $chapter" >&2
  exit 2
  ;;
esac
