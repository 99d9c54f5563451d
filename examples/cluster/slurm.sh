#!/bin/bash
# A study on Slurm: one Ray node per Slurm node, and the study on the first of them (docs/cluster.md).
#   sbatch --nodes=16 examples/cluster/slurm.sh designs/colour.toml
# The same command goes on where a study ended, for example at the time limit.
#SBATCH --job-name=dudmap-study
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=64
#SBATCH --time=08:00:00
#SBATCH --signal=B:TERM@60

set -eu
design=$1
out=${2:-runs/study/$(basename "$design" .toml)}   # on a file system that all nodes share
port=6379
export DUDMAP_THREADS=1 OMP_NUM_THREADS=1
export DUDMAP_CACHE=${DUDMAP_CACHE:-${SLURM_TMPDIR:-/tmp}/dudmap-$USER}   # recordings from URLs, on a disk of the node

mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=$(srun --nodes=1 --ntasks=1 --nodelist="${nodes[0]}" hostname --ip-address | awk '{print $1}')

srun --nodes=1 --ntasks=1 --nodelist="${nodes[0]}" \
    ray start --head --node-ip-address="$head" --port=$port --num-cpus="$SLURM_CPUS_PER_TASK" --block &
sleep 10
if [ "${#nodes[@]}" -gt 1 ]; then
    srun --nodes=$((${#nodes[@]} - 1)) --ntasks=$((${#nodes[@]} - 1)) --exclude="${nodes[0]}" \
        ray start --address="$head:$port" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
    sleep 20
fi

RAY_ADDRESS="$head:$port" dudmap study "$design" --out "$out" --cluster auto \
    --max-runs "${MAX_RUNS:-10000}" --cost-per-core-hour "${COST_PER_CORE_HOUR:-0}"
