#!/usr/bin/env bash
# Dense reconstruction of many projects, one after the other.
#
#     workflows/batch.sh ROOT [options of `colmap_sph run`]
#
# A project is a folder, at any depth below ROOT, with a sparse model in sparse/0; its result goes to dense/ beside
# sparse/, and that of sparse/1 to dense-1/. Links to folders are followed, and each project is taken once. A failure
# does not stop the batch. A project that finished without some of its images counts as done, with a warning. At the
# end a table says what became of each, and why; it is also in ROOT/colmap_sph_batch.tsv, and as a page with links to
# the reports in ROOT/colmap_sph_batch.html. The exit code is 1 where a project failed. Run it again to try those once
# more: finished results are kept.
set -u
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=${1:?usage: batch.sh ROOT [options of colmap_sph run]}
shift
[[ $root != -* ]] || root=./$root # not an option of the programs below

# The program on the PATH, or that of the README's virtual environment beside this folder.
program=$(command -v colmap_sph) || program=$here/../.venv/bin/colmap_sph
[ -x "$program" ] || { echo "colmap_sph is neither on the PATH nor in $here/../.venv" >&2; exit 2; }

has_model() { [ -e "$1/images.bin" ] || [ -e "$1/images.txt" ]; }

# As bytes: in other languages' sets of characters, names of an older one would not match.
find_models() { LC_ALL=C find -L "$root" -regextype posix-extended -regex '.*/sparse/[0-9]+' -print0; }
mapfile -d '' models < <(find_models | LC_ALL=C sort -zV)
declare -A taken
for index in "${!models[@]}"; do
    place=$(realpath -z "${models[index]%/sparse/*}" | tr '\0' /)${models[index]##*/} # $( ) cuts line breaks off
    if [ -n "${taken[$place]:-}" ] || ! has_model "${models[index]}"; then unset "models[index]"; fi
    taken[$place]=1
done
[ "${#models[@]}" -gt 0 ] || { echo "no folder with sparse/0 below $root" >&2; exit 2; }

scratch=$(mktemp -d) || exit 3
trap 'rm -rf "$scratch"' EXIT
for model in "${models[@]}"; do
    number=${model##*/}
    dense=${model%/sparse/*}/dense
    [[ $number =~ ^0+$ ]] || dense=$dense-$number
    echo "==== $model"
    # Messages go on to the standard error stream, and are kept for their last one.
    { "$program" run --model "$model" --output "$dense" "$@" 2>&1 >&3 | tee -i "$scratch/messages" >&2; } 3>&1
    code=${PIPESTATUS[0]}
    case $code in
        129 | 130 | 143) echo "interrupted at $model; the same command goes on there" >&2; exit "$code" ;;
    esac
    reason=$(sed -n 's/^error: //p' "$scratch/messages" | tail -n 1)
    printf '%s\0' "$model" "$dense" "$code" "$reason" >>"$scratch/results"
done

echo
python3 "$here/batch_summary.py" "$scratch/results" --output "$root/colmap_sph_batch"
