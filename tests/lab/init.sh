#!/bin/busybox sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The guest's first process. The kernel's command line gives LAB_CLOCK and, for a
# shell instead of tests, LAB_SHELL.
#
# The tests of /lab/plan run one by one, each in a process of its own: one that
# dies takes no other with it. Results go to the 9p share: "NAME STATUS" lines in
# results, and what each test printed in output/NAME.
export PATH=/bin HOME=/root TERM=vt100
/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs devtmpfs /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs tmpfs /dev/shm
mount -t tmpfs tmpfs /tmp
mount -t tmpfs tmpfs /run
exec </dev/console >/dev/console 2>&1

while read -r module options; do
	# $options are words.
	insmod "$module" $options || echo "lab: cannot load $module"
done </lab/modules
mount -t configfs configfs /sys/kernel/config
mount -t debugfs debugfs /sys/kernel/debug
mount -t tracefs tracefs /sys/kernel/tracing
ip link set lo up
# Tests write to hardware as root; they look for this before they do.
: >/run/pinion-lab

mount_share() {
	mkdir -p /lab/share
	mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144 lab /lab/share
}

# Prints what the kernel has logged since the last call, and fails if it found a
# fault in itself: our mocks are kernel code, too.
kernel_log() {
	dmesg -c >/tmp/kernel_log
	[ -s /tmp/kernel_log ] && { echo "kernel log:"; cat /tmp/kernel_log; }
	! grep -qE 'BUG:|WARNING:|Oops|general protection' /tmp/kernel_log
}

run_test() {
	timeout -s KILL 60 guest --exact "$1" --nocapture </dev/null
	status=$?
	[ $status = 137 ] && echo "killed: it took longer than 60 s"
	kernel_log || status=99
	return $status
}

# $1 is where the results go.
run_plan() {
	mkdir -p "$1/output"
	dmesg -c >"$1/output/boot"
	while read -r test; do
		run_test "$test" >"$1/output/$test" 2>&1
		echo "$test $?" >>"$1/results"
	done </lab/plan
}

if [ -n "$LAB_SHELL" ]; then
	mount_share
	echo "Linux $(uname -rv)"
	echo "The tests: guest --list, guest NAME --nocapture. Ctrl-A X ends the guest."
	setsid cttyhack sh -l
elif [ "$LAB_CLOCK" = instructions ]; then
	# Nothing of the host is to be met before the tests are over: its answers
	# take a time that is not the same twice.
	run_plan /tmp/lab
	mount_share
	cp -r /tmp/lab/output /lab/share
	cp /tmp/lab/results /lab/share
else
	mount_share
	run_plan /lab/share
fi
sync
# QEMU's isa-debug-exit: writing 16 ends it with status 33, which none of its own
# failures has.
printf '\020' | dd of=/dev/port bs=1 seek=244 count=1 2>/dev/null
poweroff -f
