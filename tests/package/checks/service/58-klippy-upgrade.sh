# The package is upgraded while klippy heats: nothing changes until the service is restarted.
. /share/klippy.sh
klippy_is_ready
gcode 'M140 S60'
until_true 10 is_high 3
before=$(pid)
apt-get install -y /share/later.deb
is "$(pid)" "$before" "the process"
is "$(state)" ready "klippy"
is_high 3
gcode 'M140 S0'
until_true 10 is_low 3
systemctl restart pinion-mcu
firmware_restart
systemctl stop klipper
# The next checks need the former package.
apt-get install -y --allow-downgrades /share/pinion-mcu.deb
systemctl restart pinion-mcu
