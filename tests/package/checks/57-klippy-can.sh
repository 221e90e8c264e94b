# A real klippy on a CAN bus homes and prints, and finds its MCU again after a FIRMWARE_RESTART and a kill.
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
# On a busy computer the VM wakes 10 ms late at times. So the steps are 20 ms apart, except in a long print, which skips
# the time between.
microsteps=1 speed=10 accel=50
if [ "$PRINT_S" -ge 60 ]; then microsteps=16 speed=50 accel=1000; fi
sed -i "s/^microsteps: 1$/microsteps: $microsteps/; s/^max_velocity: .*/max_velocity: $speed/" $CONFIG
sed -i "s/^max_accel: .*/max_accel: $accel/" $CONFIG
mark
systemctl start pinion-mcu
systemctl start klipper
until_state ready
# The endstops are closed where the axes stand.
for endstop in 6 2; do pull $endstop up; done
gcode 'G28 X Y'
for endstop in 6 2; do pull $endstop down; done
is "$(of toolhead homed_axes)" xy "what is homed"
# The newest values of klippy's account of the link.
account() { for count in bytes_retransmit bytes_invalid; do grep -o "$count=[0-9]*" $LOG | tail -n 1; done; }
until_true 10 grep -q bytes_retransmit= $LOG
before=$(account)
frames=/sys/class/net/vcan0/statistics/rx_packets
frames_before=$(cat $frames)
end=$((SECONDS + PRINT_S))
while [ $SECONDS -lt $end ]; do
    # At 45 degrees both motors are busy.
    gcode "G1 X30 Y30 F$((60 * speed))\nG1 X10 Y10\nG1 X10 Y30\nG1 X30 Y10"
    gcode 'G1 X29 Y12\nG1 X28 Y10\nG1 X27 Y12\nG1 X26 Y10\nG1 X20.2 Y30.4'
done
gcode 'M400\nGET_POSITION'
# Where klippy takes the motors to be, and the steps that the MCU has made.
until_true 10 grep -q 'mcu: stepper_x:' $LOG
of_klippy=$(grep -o 'mcu: stepper_x:.*' $LOG | tail -n 1 | tr -d '[:alpha:]_:' | cut -d ' ' -f 2,3)
of_mcu=$(pinion status --json | python3 -c '
import json, sys
steppers = [found for found in json.load(sys.stdin)["objects"] if found["kind"] == "stepper"]
print(*(found["value"]["steps"] for found in steppers[:2]))')
is "$of_mcu" "$of_klippy" "what the motors have done"
# 5 steps per mm, from where the axes were homed.
is "$of_mcu" "$((101 * microsteps)) $((152 * microsteps))" "where the motors are"
# Nothing was lost or sent twice.
sleep 2
is "$(account)" "$before" "klippy's account"
for count in rx_error tx_error tx_retries; do is "$(of 'canbus_stats mcu' $count)" 0 $count; done
is "$(of 'canbus_stats mcu' bus_state)" active "the state of the bus"
for count in rx_dropped rx_errors tx_dropped tx_errors; do is "$(cat ${frames%/*}/$count)" 0 $count; done
is "$(said pinion-mcu -p warning)" "" "what Pinion warned of"
echo "printed for $PRINT_S s: $(($(cat $frames) - frames_before)) frames; the motors are at $of_mcu; "$before
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
