# Completion of python -m modgnn_rl.<command> in fish; Hydra answers which choices and settings there are.
function __modgnn_rl_choices
    set -l typed (commandline -opc)
    set -l word (commandline -ct)
    if test (count $typed) -lt 3
        string split ' ' '@MODULES@'
    else if string match -q -- '-*' $word
        printf '%s\n' --cfg --config-dir --help --multirun
    else
        set -lx COMP_LINE "modgnn_rl "(string join ' ' $typed[4..-1] $word | string replace -ra '[\'"]' '')
        $typed[1] -m $typed[3] -sc query=bash 2>/dev/null
    end
end
function __modgnn_rl_asked
    set -l typed (commandline -opc)
    test "$typed[2]" = -m; and string match -q 'modgnn_rl*' -- "$typed[3]"(commandline -ct)
end
for name in python python3
    complete -c $name -n __modgnn_rl_asked -a '(__modgnn_rl_choices)'
end
