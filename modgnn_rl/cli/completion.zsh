# Completion of python -m modgnn_rl.<command> in zsh; Hydra answers which choices and settings there are.
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
_modgnn_rl() {
    local -a choices
    if [[ $words[2] != -m ]]; then
        _files
    elif (( CURRENT == 3 )); then
        compadd -- @MODULES@
    elif [[ $words[3] != modgnn_rl.* ]]; then
        _files
    elif [[ $PREFIX == -* ]]; then
        compadd -- --cfg --config-dir --help --multirun
    else
        choices=(${(f)"$(COMP_LINE="modgnn_rl ${(j: :)${(Q)words[4,CURRENT-1]}} ${(Q)PREFIX}" \
            ${~words[1]} -m $words[3] -sc query=bash 2>/dev/null)"})
        if (( $#choices )); then
            compadd -S '' -- ${(M)choices:#*[=./]}
            compadd -- ${choices:#*[=./]}
        else
            compset -P '*=' && _files
        fi
    fi
}
compdef _modgnn_rl python python3
