# Completion of python -m modgnn_rl.<command> in bash; Hydra answers which choices and settings there are.
_modgnn_rl() {
    local line=${COMP_LINE:0:COMP_POINT} word choices before=
    word=${line##*[[:space:]]}
    COMPREPLY=()
    if [[ $line =~ ^[[:space:]]*([^[:space:]]+)[[:space:]]+-m[[:space:]]+modgnn_rl[^[:space:]]*$ ]]; then
        choices="@MODULES@"
    elif [[ $line =~ ^[[:space:]]*([^[:space:]]+)[[:space:]]+-m[[:space:]]+(modgnn_rl\.[a-z_]+)[[:space:]](.*)$ ]]; then
        if [[ $word == -* ]]; then
            choices="--cfg --config-dir --help --multirun"
        else
            local typed=${BASH_REMATCH[3]//[\"\']/}
            choices=$(COMP_LINE="modgnn_rl $typed" "${BASH_REMATCH[1]/#\~/$HOME}" -m "${BASH_REMATCH[2]}" \
                -sc query=bash 2>/dev/null)
        fi
    fi
    case $word in
        [\"\']*) word=${word:1} ;;  # bash completes what follows the quote
        *)
            # Elsewhere it completes what follows the last character at which words break.
            [[ $COMP_WORDBREAKS == *=* && $word == *=* ]] && before=${word%"${word##*=}"}
            ;;
    esac
    COMPREPLY=($(compgen -W "$choices" -- "$word"))
    COMPREPLY=("${COMPREPLY[@]#"$before"}")
    # Nothing found: bash completes files, as in run=runs/... No space after a setting or group, which needs a value.
    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[=./] ]]; then
        compopt -o nospace 2>/dev/null
    fi
}
complete -o default -F _modgnn_rl python python3
