# This computer is a USB device, and by the kernel's dummy_hcd it is also the host at the other end of the cable.
[ -d /share/klipper ] || { echo 'it hung once, and nobody knows why: it runs only if KLIPPER_DIR is set'; exit 78; }
fresh
modprobe -a dummy_hcd cdc_acm
systemctl start pinion-usb-gadget
until_true 10 test -c /dev/ttyGS0
is "$(stat -c %G /dev/ttyGS0)" dialout "the group of the port"
PORT=/dev/serial/by-id/usb-Klipper_pinion_$(sha256sum /etc/machine-id | cut -c 1-12)-if00
until_true 10 test -c "$PORT"
mkdir -p /etc/pinion
printf 'board = "sim"\nlink = "serial:/dev/ttyGS0"\n' >/etc/pinion/toolhead.toml
# The host's user is in the group of serial ports.
usermod -aG dialout klippy
# (The kernel takes the port away only once nobody has it open.)
trap 'systemctl stop pinion-mcu@toolhead
    timeout 60 systemctl stop pinion-usb-gadget
    rm -f /etc/pinion/toolhead.toml
    gpasswd -d klippy dialout
    modprobe -r dummy_hcd cdc_acm' EXIT
mark
systemctl start pinion-mcu@toolhead
identifies "$PORT"
# The cable is pulled out, and plugged in again.
udc=$(cat /sys/kernel/config/usb_gadget/pinion/UDC)
echo >/sys/kernel/config/usb_gadget/pinion/UDC
until_true 10 not test -e "$PORT"
echo "$udc" >/sys/kernel/config/usb_gadget/pinion/UDC
until_true 10 test -c "$PORT"
until_true 10 identifies "$PORT"
# Its end takes the device away, also from a Pinion that serves it, and it can start again.
timeout 60 systemctl stop pinion-usb-gadget
until_true 10 not test -e /dev/ttyGS0
timeout 60 systemctl start pinion-usb-gadget
until_true 10 test -c "$PORT"
is_active pinion-mcu@toolhead
said pinion-mcu@toolhead >/run/said
for line in 'serving on /dev/ttyGS0 (USB gadget)' '/dev/ttyGS0 is gone' '/dev/ttyGS0 is there'; do grep "$line" /run/said; done
