#!/bin/busybox sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The first process of the emulated Pi. It sends lines that begin with "raspberry-pi: " to the computer over the
# console. Tests do the same (guest/outside.rs).
. /tests/start.sh
echo 'tty:x:5:' >/etc/group

say() {
	echo "raspberry-pi: $*"
}

if [ -n "$GUEST_SHELL" ]; then
	echo "Linux $(uname -rv) on $(tr '\0' '\n' </proc/device-tree/model)"
	echo "Programs: pinion, and raspberry_pi_guest whose tests need the host. Ctrl-A X ends the guest."
	setsid cttyhack sh -l
	sync
	poweroff -f
fi

stty raw -echo
# Keeps the processor from idling. While it idles, time would pass at the computer's pace: see TIME in vm.rs. Everything
# is on one processor. Two would take turns of milliseconds.
taskset -p 1 $$ >/dev/null
(while :; do :; done) &
renice -n 19 -p $!
# The requested filters, as libtest's words, one per line.
set --
while read -r word; do
	set -- "$@" "$word"
done </tests/filters
raspberry_pi_guest --list --format terse "$@" | sed -n 's/: test$//p' >/tmp/plan
say plan $(cat /tmp/plan)
while read -r test <&3; do
	say begin "$test"
	timeout -s KILL 30 raspberry_pi_guest --exact "$test" --nocapture </dev/null 2>&1
	status=$?
	[ $status = 137 ] && echo "killed: it took longer than 30 s"
	# A fault of the driver.
	if dmesg -c | grep -E 'BUG:|WARNING:|Oops|Internal error'; then
		status=99
	fi
	say end "$test" $status
done 3</tmp/plan
say done
# The computer ends the VM, because the VM cannot do that itself.
while :; do
	sleep 60
done
