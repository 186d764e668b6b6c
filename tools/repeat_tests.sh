#!/usr/bin/env bash
# Runs the whole suite again and again, each time in a fresh clone with an empty home, and counts:
#   tools/repeat_tests.sh RUNS [BUSY] [FOLDER]
# BUSY is the number of busy loops beside it (0). Logs stay in FOLDER (a new one), and of a run that
# failed its temporary files; what failed is printed after each run. Exit code: 0 if every run passed.
set -uo pipefail
runs=${1:?how many runs} busy=${2:-0} folder=${3:-$(mktemp -d)}
mkdir -p "$folder" && folder=$(cd "$folder" && pwd) || exit 2
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
trap 'kill $(jobs -p) 2>/dev/null' EXIT
for _ in $(seq "$busy"); do while :; do :; done & done
failed=0
for run in $(seq "$runs"); do
    clone=$folder/$run home=$folder/home_$run files=$folder/files_$run begun=$SECONDS
    rm -rf "$clone" "$home" "$files" && mkdir -p "$home" "$files" && git clone --quiet "$source" "$clone" || exit 2
    if env -i HOME="$home" TMPDIR="$files" PATH="$PATH" LANG=C.UTF-8 \
        PYTEST_ADDOPTS="-o tmp_path_retention_count=9" \
        make -k -C "$clone" test faults repository busy >"$folder/$run.log" 2>&1
    then result=passed && rm -rf "$files"
    else result=FAILED failed=$((failed + 1))
    fi
    echo "run $run of $runs, $busy busy loops: $result in $((SECONDS - begun)) s"
    grep -hE "^(FAILED|ERROR) |[0-9]+ passed" "$folder/$run.log" | sed 's/^/    /'
    rm -rf "$clone" "$home"
done
echo "$failed of $runs runs failed; logs: $folder"
exit $((failed > 0))
