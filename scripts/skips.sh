#!/usr/bin/env bash
# Lists the tests that were skipped, and which of them tests/may-skip.txt does not permit.
#
#     skips.sh FILE
#
# FILE has a line `NAME: REASON` for each, as tests/support/skip.rs and scripts/models-tests.sh append them. With CI=true the
# exit code is 1 if one is not permitted: a machine of ours has what they need.
set -euo pipefail
[[ $# = 1 && -f $1 ]] || { echo "usage: skips.sh FILE" >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."

patterns=()
while read -r pattern _; do
    [[ -z $pattern || $pattern = '#'* ]] || patterns+=("$pattern")
done <"${MAY_SKIP:-tests/may-skip.txt}"

may_skip() {
    local pattern
    for pattern in ${patterns[@]+"${patterns[@]}"}; do
        # shellcheck disable=SC2053 # it is a pattern
        [[ $1 != $pattern ]] || return 0
    done
    return 1
}

# A test that ran twice was skipped once.
mapfile -t skipped < <(sort -u "$1" | sed '/^$/d')
case ${#skipped[@]} in
    0) echo "No test was skipped." ;;
    1) echo "1 test was skipped:" ;;
    *) echo "${#skipped[@]} tests were skipped:" ;;
esac
code=0
for line in ${skipped[@]+"${skipped[@]}"}; do
    if may_skip "${line%%: *}"; then
        echo "    $line"
    else
        echo "    $line (not permitted by tests/may-skip.txt)"
        code=1
    fi
done
[[ ${CI:-} = true ]] || exit 0
[[ $code = 0 ]] || echo "error: in CI no other test may be skipped" >&2
exit "$code"
