#!/usr/bin/env bash
# Dense reconstruction of many projects, one after the other.
#
#     workflows/batch.sh ROOT [options of `colmap_sph run`]
#
# A project is a folder, at any depth below ROOT, with a sparse model in sparse/0; its result goes to dense/ beside
# sparse/. A failure does not stop the batch. A project that finished without some of its images counts as done, with
# a warning. The exit code is 1 where a project failed. Run it again to try those once more: finished results are kept.
set -u
root=${1:?usage: batch.sh ROOT [options of colmap_sph run]}
shift

mapfile -d '' models < <(find "$root" -type d -path '*/sparse/0' -print0 | sort -z)
[ "${#models[@]}" -gt 0 ] || { echo "no folder with sparse/0 below $root" >&2; exit 2; }

points() { sed -n 's/^ "points": \([0-9]*\).*/\1/p' "$1/dense/colmap_sph/report.json"; }

failed=0 summary=()
for model in "${models[@]}"; do
    project=${model%/sparse/0}
    echo "==== $project"
    colmap_sph run --model "$model" --output "$project/dense" "$@"
    code=$?
    case $code in
        130 | 143) echo "interrupted at $project; the same command goes on there" >&2; exit "$code" ;;
        0) result="$(points "$project") points" ;;
        5) result="$(points "$project") points; WARNING: without some images, see dense/colmap_sph/report.json" ;;
        2) result="FAILED: input or options" ;;
        3) result="FAILED: cannot write" ;;
        4) result="FAILED: nothing to reconstruct" ;;
        6) result="FAILED: not enough memory" ;;
        *) result="FAILED: exit code $code" ;;
    esac
    case $code in 0 | 5) ;; *) failed=$((failed + 1)) ;; esac
    summary+=("$(printf '%-40s %s' "$project" "$result")")
done

printf '\n==== %d projects, %d failed\n' "${#models[@]}" "$failed"
printf '%s\n' "${summary[@]}"
[ "$failed" -eq 0 ]
