# A real klippy with Pinion as its only MCU: all its devices answer, and it homes.
. /share/klippy.sh
mark
printf '01900000%.0s' {1..400} >/run/replies
cat /run/replies >$MOCKS/mock-spi/replies
klippy_is_ready
# Its sources are read through its own root, because the service sees no homes. So it gets its own dialect.
said | grep 'the host is klippy of /home/klippy/klipper.*: dialect '
is "$(said pinion-mcu -p warning)" "" "a warning in the log"
until_true 20 measures heater_bed 24 26
until_true 20 measures 'temperature_sensor chamber' 75 90
until_true 20 measures 'temperature_sensor thermocouple' 25 25
until_true 20 measures 'temperature_sensor i2c' 27.5 27.5
until_true 20 measures 'temperature_sensor wire' 21.5 21.5

gcode 'SET_PIN PIN=light VALUE=1'
until_true 10 is_high 14
gcode 'SET_PIN PIN=light VALUE=0'
until_true 10 is_low 14
pull 8 up
until_true 10 is_high 14
pull 8 down
gcode 'SET_PIN PIN=light VALUE=0'
gcode 'SET_PIN PIN=dimmer VALUE=0.25'
until_true 10 grep '^1 1000000 250000 1 ' $MOCKS/mock-pwm/outputs
gcode 'M106 S255'
until_true 10 is_high 9
gcode 'M107'
until_true 10 is_low 9
gcode 'M140 S60'
until_true 10 is_high 3
gcode 'M140 S0'
until_true 10 is_low 3

moves() { not [ "$(of motion_report live_velocity)" = 0.0 ]; }
gcode 'G28 X' >/run/homing 2>&1 &
homing=$!
until_true 20 moves
pull 6 up
wait $homing || { cat /run/homing; false; }
pull 6 down
is "$(of toolhead homed_axes)" x "what is homed"
gcode 'G1 X10 F300'
gcode M400
is "$(of motion_report live_position/0)" 10.0 "where it stands"
pinion status | tee /run/status
grep -i klippy /run/status >/dev/null
pinion doctor | sed -n '/^terminal/,/^[a-su-z]/p; /^host/,/^[a-gi-z]/p'
systemctl stop klipper
