#!/bin/sh
# Asks many things of a scene from a shell: one warm process, JSON lines in, JSON lines out.
#
#     sh examples/08_shell.sh [SCENE [THING ...]]
#
# SCENE is a folder that `lexsplat build` made, or the word "demo" for the scene that ships with lexsplat. Prints a
# table: thing, whether it is there, how many, best view. Where `lexsplat` is in an environment that is not active:
#
#     LEXSPLAT=.venv/bin/lexsplat PYTHON=.venv/bin/python sh examples/08_shell.sh
lexsplat=${LEXSPLAT:-lexsplat}
python=${PYTHON:-python3}
scene=${1:-demo}
command -v "${lexsplat%% *}" > /dev/null || { echo "$lexsplat: not found; set LEXSPLAT to its path" >&2; exit 1; }
$lexsplat info "$scene" > /dev/null || exit 1
[ $# -gt 0 ] && shift
[ $# -gt 0 ] || set -- apple mug unicorn "thing left of the vase"

for thing in "$@"; do
    quoted=$(printf '%s' "$thing" | tr '\t\n' '  ' | sed 's/[\\"]/\\&/g')
    printf '{"ask": "%s", "id": "%s"}\n' "$quoted" "$quoted"
done |
    $lexsplat ask "$scene" --stdin |
    while IFS= read -r line; do
        printf '%s\n' "$line" | $python -c '
import json, sys
answer = json.load(sys.stdin)
if "error" in answer:
    print(answer.get("id"), "error", answer["error"]["message"], sep="\t")
else:
    print(answer["id"], answer["present"], answer["count"], answer["best_view"] or "-", sep="\t")
'
    done
