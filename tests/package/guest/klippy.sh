# SPDX-License-Identifier: GPL-3.0-or-later
# The functions of the checks with a real klippy. A check reads them with `. /share/klippy.sh`. klippy lives in klippy's
# home. A unit in KIAUH's form runs it.
[ -d /share/klipper ] || { echo 'KLIPPER_DIR names no checkout of Klipper'; exit 78; }
# (The command that failed may have its output in /dev/null.)
trap '{
    echo "failed: line $LINENO: $BASH_COMMAND"
    journalctl -n 25 --no-pager -u "pinion-mcu*" -u klipper 2>/dev/null
    grep -v "^Stats\|^Receive\|^Sent\|: got {\|^webhooks" $LOG | tail -n 40
} >&2' ERR

DATA=/home/klippy/printer_data
API=$DATA/comms/klippy.sock
LOG=$DATA/logs/klippy.log
CONFIG=$DATA/config/printer.cfg
MOCKS=/sys/devices/platform
# Python in the emulator starts many times slower than on a Raspberry Pi.
START=90

pull() { echo "pull-$2" >"$CHIP/sim_gpio$1/pull"; }
# ask METHOD PARAMS POINTER
ask() { host ask "$API" "$@"; }
gcode() { ask gcode/script "{ \"script\": \"$1\" }" "" >/dev/null; }
# of OBJECT FIELD
of() { ask objects/query "{ \"objects\": { \"$1\": null } }" "/status/$1/$2"; }
state() { ask info '{}' /state; }
# klippy's message about its state, as Mainsail and Fluidd show it.
why() { ask info '{}' /state_message; }
says() { why | grep "$1" >/dev/null; }
# between VALUE LEAST MOST
between() { awk -v value="$1" -v least="$2" -v most="$3" 'BEGIN { exit !(value >= least && value <= most) }'; }
measures() { between "$(of "$1" temperature)" "$2" "$3"; }
# until_state STATE: polls rarely, because klippy starts on one slow processor.
until_state() {
    local end=$((SECONDS + START))
    until [ "$(state 2>/dev/null)" = "$1" ]; do
        [ $SECONDS -lt $end ] || fail "klippy is in $(state), not in $1: $(why)"
        sleep 1
    done
}
# A user's usual remedy. (klippy closes the connection of the sender.)
firmware_restart() {
    gcode FIRMWARE_RESTART || true
    until_state ready
}

# A printer with Pinion as its only MCU, and the environment of the computer's pins.
configure() {
    # 25 and 82 degrees, with a resistor of 4.7 kOhm.
    echo 3911 >"$MOCKS/mock-adc.0/iio:device0/in_voltage0_raw"
    echo 2786 >"$MOCKS/mock-adc.0/iio:device0/in_voltage1_raw"
    # 27.5 degrees in an LM75's register.
    echo '50 0 1b' >$MOCKS/mock-i2c/change
    echo '50 1 80' >$MOCKS/mock-i2c/change
    echo '0 21500' >$MOCKS/mock-w1/temperature
    pull 6 down
    pull 8 down
    local bus
    bus=$(basename $MOCKS/mock-i2c/i2c-*)
    cat >$CONFIG <<END
[mcu]
serial: $LINK

[printer]
kinematics: cartesian
max_velocity: 10
max_accel: 50

[stepper_x]
step_pin: STEP
dir_pin: DIR
endstop_pin: ENDSTOP
microsteps: 1
rotation_distance: 40
position_max: 50
position_endstop: 0
homing_speed: 5
homing_retract_dist: 0

[stepper_y]
step_pin: lab/gpio0
dir_pin: lab/gpio1
endstop_pin: lab/gpio2
microsteps: 1
rotation_distance: 40
position_max: 50
position_endstop: 0
homing_retract_dist: 0

[stepper_z]
step_pin: lab/gpio10
dir_pin: lab/gpio11
endstop_pin: lab/gpio12
microsteps: 1
rotation_distance: 40
position_max: 50
position_endstop: 0

[heater_bed]
heater_pin: HEATER
sensor_type: Generic 3950
sensor_pin: analog0
control: watermark
min_temp: 0
max_temp: 130

[temperature_sensor chamber]
sensor_type: Generic 3950
sensor_pin: mock-adc12/voltage1
min_temp: 0
max_temp: 130

[temperature_sensor thermocouple]
sensor_type: MAX31855
spi_bus: spidev0.0
sensor_pin: lab/gpio15
min_temp: -10
max_temp: 100

[temperature_sensor i2c]
sensor_type: LM75
i2c_bus: i2c.${bus#i2c-}
i2c_address: 80
min_temp: 0
max_temp: 100

[temperature_sensor wire]
sensor_type: DS18B20
serial_no: 28-000000001001
sensor_mcu: mcu
min_temp: 0
max_temp: 100

[output_pin light]
pin: lab/gpio14

[output_pin dimmer]
pin: pwmchip0/pwm1
pwm: True
hardware_pwm: True
cycle_time: 0.001
shutdown_value: 0

[fan]
pin: lab/gpio9

[gcode_button knob]
pin: lab/gpio8
press_gcode:
    SET_PIN PIN=light VALUE=1
END
}

# For print_a_while. On a busy computer the VM wakes 10 ms late at times. So the steps are 20 ms apart, except in a long
# print, which skips the time between.
for_a_print() {
    microsteps=1 speed=10 accel=50
    if [ "$PRINT_S" -ge 60 ]; then microsteps=16 speed=50 accel=1000; fi
    sed -i "s/^microsteps: 1$/microsteps: $microsteps/; s/^max_velocity: .*/max_velocity: $speed/" $CONFIG
    sed -i "s/^max_accel: .*/max_accel: $accel/" $CONFIG
}
# The endstops are closed where the axes stand.
home_xy() {
    local endstop
    for endstop in 6 2; do pull $endstop up; done
    gcode 'G28 X Y'
    for endstop in 6 2; do pull $endstop down; done
    is "$(of toolhead homed_axes)" xy "what is homed"
}
# For $PRINT_S. Then the motors are where klippy has them. of_mcu has the steps of both.
print_a_while() {
    local end=$((SECONDS + PRINT_S)) of_klippy
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
}

# Once per VM.
install_klippy() {
    [ ! -e /etc/systemd/system/klipper.service ] || return 0
    mkdir -p $DATA/config $DATA/logs $DATA/comms $DATA/systemd
    cp -a /share/klipper /home/klippy/klipper
    cat >$DATA/systemd/klipper.env <<END
KLIPPER_ARGS="/home/klippy/klipper/klippy/klippy.py $CONFIG -I $DATA/comms/klippy.serial -l $LOG -a $API"
END
    chown -R klippy: /home/klippy
    cat >/etc/systemd/system/klipper.service <<END
[Unit]
Description=Klipper
After=network-online.target
Wants=udev.target

[Service]
Type=simple
User=klippy
RemainAfterExit=yes
WorkingDirectory=/home/klippy/klipper
EnvironmentFile=$DATA/systemd/klipper.env
ExecStart=/usr/bin/python3 \$KLIPPER_ARGS
Restart=always
RestartSec=10

[Install]
WantedBy=multi-user.target
END
    systemctl daemon-reload
}

# klippy is installed, and ready with the configuration above. An earlier check may have left the MCU shut down, for
# example because nobody refreshed a heater. klippy then needs a FIRMWARE_RESTART.
klippy_is_ready() {
    fresh
    install_klippy
    configure
    systemctl stop klipper
    systemctl restart pinion-mcu
    systemctl start klipper
    until_state ready
}
