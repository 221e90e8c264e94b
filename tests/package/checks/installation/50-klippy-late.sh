# klippy starts before Pinion, and waits. Then both are enabled, and the computer boots.
. /share/klippy.sh
install_klippy
configure
fresh
systemctl stop klipper pinion-mcu
rm -f $LOG
systemctl start klipper
until_true $START grep 'Unable to open .*port: ' $LOG
systemctl start pinion-mcu
until_state ready
# The mocks lose their settings when the computer boots, so this configuration has no sensors.
cat >$CONFIG <<END
[mcu]
serial: $LINK

[printer]
kinematics: none
max_velocity: 1
max_accel: 1

[output_pin light]
pin: lab/gpio14

[gcode_button knob]
pin: lab/gpio8
press_gcode:
    SET_PIN PIN=light VALUE=1
END
systemctl enable klipper pinion-mcu
exit 77
