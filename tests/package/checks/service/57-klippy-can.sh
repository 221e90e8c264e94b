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
for_a_print
mark
systemctl start pinion-mcu
systemctl start klipper
until_state ready
home_xy
# The newest values of klippy's account of the link.
account() { for count in bytes_retransmit bytes_invalid; do grep -o "$count=[0-9]*" $LOG | tail -n 1; done; }
until_true 10 grep -q bytes_retransmit= $LOG
before=$(account)
frames=/sys/class/net/vcan0/statistics/rx_packets
frames_before=$(cat $frames)
print_a_while
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
