# Pinion is restarted, and killed, while klippy runs with the heater and a light on. They go off, klippy reports the
# cause, and FIRMWARE_RESTART is enough to continue.
. /share/klippy.sh
lit() {
    gcode 'SET_PIN PIN=light VALUE=1'
    gcode 'M140 S60'
    until_true 10 is_high 14
    until_true 10 is_high 3
}
# off SECONDS WHAT-KLIPPY-SAYS
off() {
    until_true "$1" is_low 3
    is_low 14
    until_state shutdown
    why
    says "$2"
    until_true 30 is_active pinion-mcu
}
klippy_is_ready
lit
systemctl restart pinion-mcu
off 1 'Force shutdown command'
firmware_restart
lit
kill -9 "$(pid)"
off 8 "Lost communication with MCU 'mcu'"
firmware_restart
lit
systemctl stop klipper
