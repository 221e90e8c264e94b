# A real klippy on a CAN bus homes an axis, and finds its MCU again after a FIRMWARE_RESTART and a kill.
. /share/klippy.sh
fresh
install_klippy
systemctl stop klipper pinion-mcu
ip link show vcan0 >/dev/null 2>&1 || ip link add vcan0 type vcan
ip link set vcan0 up
cp /etc/pinion/pinion.toml /run/pinion.toml
trap 'cp /run/pinion.toml /etc/pinion/pinion.toml; rm -rf /etc/systemd/system/pinion-mcu.service.d; systemctl daemon-reload' EXIT
echo 'link = "can:vcan0,0123456789ab"' >>/etc/pinion/pinion.toml
install -D -m 644 /usr/share/pinion-mcu/can.conf /etc/systemd/system/pinion-mcu.service.d/can.conf
systemctl daemon-reload
configure
sed -i "s|^serial: $LINK|canbus_uuid: 0123456789ab\ncanbus_interface: vcan0|" $CONFIG
systemctl start pinion-mcu
systemctl start klipper
until_state ready
pull 6 up
gcode 'G28 X'
pull 6 down
is "$(of toolhead homed_axes)" x "what is homed"
is "$(of 'canbus_stats mcu' bus_state)" active "the state of the bus"
gcode 'SET_PIN PIN=light VALUE=1'
until_true 10 is_high 14
firmware_restart
# The outputs go to their shutdown values, and klippy finds the new MCU.
gcode 'SET_PIN PIN=light VALUE=1'
until_true 10 is_high 14
kill -9 "$(pid)"
until_true 10 is_low 14
until_state shutdown
until_true 20 is_active pinion-mcu
firmware_restart
systemctl stop klipper pinion-mcu
