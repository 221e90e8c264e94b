# The program has no capabilities. The process that searches for the host has two, and may only read.
fresh
systemctl start pinion-mcu
# A thread may end before its file is read.
sets() { { sed -n 's/^Cap\(Inh\|Prm\|Eff\|Amb\):\t//p' "$@" 2>/dev/null || true; } | sort -u; }
is "$(sets "/proc/$(pid)"/task/*/status)" 0000000000000000 "the program's capabilities"
is "$(sets "/proc/$(guardian)/status")" 0000000000000000 "the guardian's"
search=$(pgrep -P "$(pid)" -x pinion-search)
is "$(sed -n 's/^Cap\(Prm\|Eff\):\t//p' "/proc/$search/status" | sort -u)" 0000000000080004 "those of the search"
is "$(sed -n 's/^Seccomp:\t//p' "/proc/$search/status")" 2 "its seccomp mode"
# Of the kernel's settings, it may write only to devices. (Root has the same limits in the service.)
inside() { nsenter -t "$(pid)" -m -- sh -c "$1"; }
inside 'echo 2 >/sys/class/pwm/pwmchip0/export'
inside 'echo 2 >/sys/class/pwm/pwmchip0/unexport'
not inside ': >>/proc/sys/kernel/printk'
not inside ': >>/sys/module/printk/parameters/time'
not inside 'test -L /tmp/klipper_host_mcu'
# The search examines a host of klippy's user.
mark
identifies
looked() { said | grep 'is not a klippy'; }
until_true 10 looked
# A killed search is reported, and the service continues.
before=$(pid)
kill -9 "$search"
identifies
is "$(pid)" "$before" "the process"
systemctl stop pinion-mcu
said pinion-mcu -p warning | grep 'the search for the host has ended'
not pgrep -x pinion-search
