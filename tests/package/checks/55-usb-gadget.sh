# This computer is a USB device, and by the kernel's dummy_hcd it is also the host at the other end of the cable.
fresh
modprobe -a dummy_hcd cdc_acm
systemctl start pinion-usb-gadget
until_true 10 test -c /dev/ttyGS0
is "$(stat -c %G /dev/ttyGS0)" dialout "the group of the port"
PORT=/dev/serial/by-id/usb-Klipper_pinion_$(sha256sum /etc/machine-id | cut -c 1-12)-if00
until_true 10 test -c "$PORT"
mkdir -p /etc/pinion
printf 'board = "sim"\nlink = "serial:/dev/ttyGS0"\n' >/etc/pinion/toolhead.toml
trap 'systemctl stop pinion-mcu@toolhead pinion-usb-gadget; rm -f /etc/pinion/toolhead.toml' EXIT
mark
systemctl start pinion-mcu@toolhead
said pinion-mcu@toolhead | grep 'serving on /dev/ttyGS0 (USB gadget)'
# The host's user is in the group of serial ports.
usermod -aG dialout klippy
identifies "$PORT"
said pinion-mcu@toolhead | grep 'host attached'
# The cable is pulled out, and plugged in again.
udc=$(cat /sys/kernel/config/usb_gadget/pinion/UDC)
echo >/sys/kernel/config/usb_gadget/pinion/UDC
until_true 10 not test -e "$PORT"
until_true 10 eval 'said pinion-mcu@toolhead | grep -q "/dev/ttyGS0 is gone"'
echo "$udc" >/sys/kernel/config/usb_gadget/pinion/UDC
until_true 10 test -c "$PORT"
until_true 10 eval 'said pinion-mcu@toolhead | grep -q "/dev/ttyGS0 is there"'
identifies "$PORT"
# Its end takes the device away, also from a Pinion that serves it.
systemctl stop pinion-usb-gadget
until_true 10 not test -e /dev/ttyGS0
is_active pinion-mcu@toolhead
systemctl start pinion-usb-gadget
until_true 10 test -c "$PORT"
until_true 10 identifies "$PORT"
