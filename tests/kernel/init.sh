#!/bin/busybox sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The guest's first process. With GUEST_SHELL on the kernel's command line it starts a shell instead of the tests.
#
# The tests of the plan run one by one, each in its own process. So a test that dies does not end the others. A line of
# the plan has a test, the seconds of a print to measure, and maybe a command: the program to measure instead of pinion.
# Results go to the 9p share: lines "NAME STATUS" in results, and each test's output in output/NAME. Each test's name goes
# to the console when it starts.
. /tests/start.sh

while read -r module options; do
	# $options is split into words.
	insmod "$module" $options || echo "cannot load $module"
done </tests/modules
# Tests with ADCs bind them again (guest/mock/adc.rs).
for adc in /sys/bus/platform/drivers/mock-adc/mock-adc.*; do
	echo "${adc##*/}" >/sys/bus/platform/drivers/mock-adc/unbind
done
mount -t configfs configfs /sys/kernel/config
mount -t debugfs debugfs /sys/kernel/debug
mount -t tracefs tracefs /sys/kernel/tracing
ip link set lo up

mount_share() {
	mkdir -p /tests/share
	mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144 tests /tests/share
}

# Unpacks the programs under test: they are in the memory of QEMU's ivshmem. The third line of its resources has the place.
unpack_programs() {
	for device in /sys/bus/pci/devices/*; do
		[ "$(cat "$device/vendor" "$device/device" | tr -d '\n')" = 0x1af40x1110 ] && break
	done
	read -r begin end _ <<-END
		$(sed -n 3p "$device/resource")
	END
	echo "programs,$begin,$((end - begin + 1))" >/sys/module/phram/parameters/phram
	(cd / && cpio -idu </dev/mtd0ro)
}

# Writes one byte, in octal, to a port.
out() {
	printf "\\$2" | dd of=/dev/port bs=1 seek=$(($1)) count=1 2>/dev/null
}

# Prints the kernel's log since the last call. Fails if the kernel reported its own fault, because our mocks are also
# kernel code.
kernel_log() {
	dmesg -c >/tmp/kernel_log
	[ -s /tmp/kernel_log ] && { echo "kernel log:"; cat /tmp/kernel_log; }
	! grep -qE 'BUG:|WARNING:|Oops|general protection' /tmp/kernel_log
}

# Programs with counters (scripts/coverage) keep them there.
export LLVM_PROFILE_FILE=/tmp/tests/output/%m%c.profraw

run_test() {
	limit=$((90 + $2))
	PRINT_SECONDS=$2 MEASURED_PROGRAM=$3 timeout -s KILL $limit guest --exact "$1" --nocapture </dev/null
	status=$?
	[ $status = 137 ] && echo "killed: it took longer than $limit s"
	kernel_log || status=99
	return $status
}

if [ -n "$GUEST_SHELL" ]; then
	mount_share
	unpack_programs
	echo "Linux $(uname -rv)"
	echo "The tests: guest --list, guest NAME --nocapture. Ctrl-A X ends the guest."
	setsid cttyhack sh -l
	sync
	poweroff -f
fi

# The kernel's delayed start is then over. Its last part is the choice of the processor's counter as its clock, two
# seconds after boot.
sleep 10
# QEMU's pvpanic stops the VM here, at exactly this instruction. The computer takes a snapshot. Each run continues from
# the snapshot with its own plan.
out 0x505 001
# This driver lists the computer's files when it is loaded, so it must not be loaded earlier.
insmod /tests/plan.ko
unpack_programs
# Each read of this file begins at the start.
cat /sys/firmware/qemu_fw_cfg/by_name/opt/pinion/plan/raw >/tmp/plan
mkdir -p /tmp/tests/output
dmesg -c >/tmp/tests/output/boot
while read -r test print_seconds program; do
	echo "test: $test"
	run_test "$test" "$print_seconds" "$program" >"/tmp/tests/output/$test" 2>&1
	echo "$test $?" >>/tmp/tests/results
done </tmp/plan
# Do not use the computer before the tests are over: the time of its answers is never the same twice.
mount_share
cp -r /tmp/tests/output /tests/share
cp /tmp/tests/results /tests/share
sync
# QEMU's isa-debug-exit: writing 16 ends it with status 33. None of QEMU's own failures has this status.
out 0xf4 020
poweroff -f
