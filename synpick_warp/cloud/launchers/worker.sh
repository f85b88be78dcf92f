#!/usr/bin/env bash
#SBATCH --job-name=synpick-warp
#SBATCH --array=0-63
#SBATCH --gpus=1
#SBATCH --cpus-per-task=12
#SBATCH --mem=48G
#SBATCH --time=04:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
# A claiming worker under a scheduler: worker.sh OPTIONS OF BAKE, such as --out s3://bucket/set --config synpick. See README.md.
#
# SIGTERM is passed on: the bake uploads what is finished and gives its claim back. Exit codes: 0, all episodes are done; 2, a mistake;
# 143, stopped before: the scheduler starts it again, Slurm on request.
set -u
export WARP_CACHE_PATH=${WARP_CACHE_PATH:-${TMPDIR:-/tmp}/kernels-$(id -u)} # On the node's own disk.

synpick-warp bake --claim "$@" &
bake=$!
trap 'kill -TERM "$bake" 2>/dev/null' TERM
while wait "$bake"; code=$?; kill -0 "$bake" 2>/dev/null; do :; done # A signal ends `wait`, not the bake.

if [ "$code" -eq 1 ]; then
    code=0 # Episodes were given up, and would be again.
elif [ "$code" -eq 143 ] && [ -n "${SLURM_JOB_ID:-}" ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
