# Another instance in addition to the first one, with its own configuration.
pinion run --help | grep -e --config >/dev/null || { echo 'NOT RUN: this pinion takes no --config'; exit 0; }
fresh
systemctl start pinion-mcu
mkdir -p /etc/pinion
echo 'board = "sim"' >/etc/pinion/second.toml
systemctl start pinion-mcu@second
identifies /tmp/klipper_host_second
identifies $LINK HEATER
systemctl stop pinion-mcu@second
[ ! -L /tmp/klipper_host_second ]
identifies
rm /etc/pinion/second.toml
