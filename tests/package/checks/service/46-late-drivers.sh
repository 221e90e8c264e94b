# systemd looks up the drivers of DeviceAllow= when it starts the unit. The unit loads them first. So a chip that appears
# later works for the next host, without a restart.
has() { grep -q "^ *[0-9]* $1\$" /proc/devices; }
# may MAJOR MINOR: a process of the service may open the device of these numbers, if there is one.
may() {
    rm -f /dev/probe
    mknod /dev/probe c "$1" "$2"
    (echo $BASHPID >/sys/fs/cgroup/system.slice/pinion-mcu.service/cgroup.procs && exec 3<>/dev/probe) 2>/run/probe || true
    rm /dev/probe
    if grep 'Operation not permitted' /run/probe; then return 1; fi
}
fresh
systemctl stop pinion-mcu
modprobe -r mock_i2c i2c-dev mock_adc cdc_acm u_serial
modprobe -r industrialio
for driver in i2c iio ttyACM ttyGS; do not has $driver; done
systemctl start pinion-mcu
for driver in i2c iio ttyACM ttyGS; do has $driver; done
identifies
before=$(pid)
# As udev loads the drivers of devices that it finds.
modprobe -a i2c-dev mock_i2c industrialio mock_adc cdc_acm u_serial
bus=$(basename /sys/devices/platform/mock-i2c/i2c-*)
owner_of_bus() { [ "$(stat -c %G "/dev/$bus")" = i2c ]; }
until_true 10 owner_of_bus
klippy /share/host open $LINK "i2c.${bus#i2c-}"
is "$(pid)" "$before" "the process"
# An adapter on USB, the port of a USB gadget, and an ADC.
for driver in ttyACM ttyGS iio; do may "$(awk -v driver=$driver '$2 == driver { print $1 }' /proc/devices)" 0; done
# ttyS0, ttyS4 and ttyS31, but no virtual console, which has the same driver's number, and no memory.
for port in 64 68 95; do may 4 $port; done
not may 4 1
not may 1 1
# A serial port for the host may be one of a USB gadget. Each instance follows its service.
for unit in pinion-mcu pinion-mcu@any; do systemctl show -P After $unit | grep -w pinion-usb-gadget.service; done
