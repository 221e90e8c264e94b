#!/bin/busybox sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The guest's first process. The kernel's command line gives GUEST_SHELL for a shell
# instead of tests.
#
# The tests of the plan run one by one, each in a process of its own: one that
# dies takes no other with it. A line of the plan may have a command after the test,
# whose program that is to measure instead of pinion. Results go to the 9p share: "NAME STATUS" lines in
# results, and what each test printed in output/NAME. Each test's name goes to the
# console as it begins.
. /tests/start.sh

while read -r module options; do
	# $options are words.
	insmod "$module" $options || echo "cannot load $module"
done </tests/modules
mount -t configfs configfs /sys/kernel/config
mount -t debugfs debugfs /sys/kernel/debug
mount -t tracefs tracefs /sys/kernel/tracing
ip link set lo up

mount_share() {
	mkdir -p /tests/share
	mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144 tests /tests/share
}

# Writes one byte, octal, to a port.
out() {
	printf "\\$2" | dd of=/dev/port bs=1 seek=$(($1)) count=1 2>/dev/null
}

# Prints what the kernel has logged since the last call, and fails if it found a
# fault in itself: our mocks are kernel code, too.
kernel_log() {
	dmesg -c >/tmp/kernel_log
	[ -s /tmp/kernel_log ] && { echo "kernel log:"; cat /tmp/kernel_log; }
	! grep -qE 'BUG:|WARNING:|Oops|general protection' /tmp/kernel_log
}

run_test() {
	MEASURED_PROGRAM=$2 timeout -s KILL 60 guest --exact "$1" --nocapture </dev/null
	status=$?
	[ $status = 137 ] && echo "killed: it took longer than 60 s"
	kernel_log || status=99
	return $status
}

if [ -n "$GUEST_SHELL" ]; then
	mount_share
	echo "Linux $(uname -rv)"
	echo "The tests: guest --list, guest NAME --nocapture. Ctrl-A X ends the guest."
	setsid cttyhack sh -l
	sync
	poweroff -f
fi

# What the kernel leaves for later at its start is then behind it: the last of it is the
# choice of the processor's counter as its clock, two seconds after boot.
sleep 10
# QEMU's pvpanic stops the machine here, at this very instruction. The host takes a
# snapshot, and each run goes on from that, with a plan of its own.
out 0x505 001
# This driver lists the host's files as it is loaded: not before.
insmod /tests/plan.ko
# A file of which each read begins at the start.
cat /sys/firmware/qemu_fw_cfg/by_name/opt/pinion/plan/raw >/tmp/plan
mkdir -p /tmp/tests/output
dmesg -c >/tmp/tests/output/boot
while read -r test program; do
	echo "test: $test"
	run_test "$test" "$program" >"/tmp/tests/output/$test" 2>&1
	echo "$test $?" >>/tmp/tests/results
done </tmp/plan
# Nothing of the host is to be met before the tests are over: its answers take a
# time that is not the same twice.
mount_share
cp -r /tmp/tests/output /tests/share
cp /tmp/tests/results /tests/share
sync
# QEMU's isa-debug-exit: writing 16 ends it with status 33, which none of its own
# failures has.
out 0xf4 020
poweroff -f
