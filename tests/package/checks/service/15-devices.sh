# Without a reboot each device belongs to the group in the rules.
owner() { stat -c '%G %a' "$1"; }
is "$(owner /dev/gpiochip0)" "gpio 660" gpiochip0
is "$(owner /dev/watchdog)" "pinion 660" watchdog
is "$(owner /dev/watchdog0)" "pinion 660" watchdog0
is "$(owner /dev/spidev0.0)" "spi 660" spidev0.0
for bus in /dev/i2c-*; do is "$(owner "$bus")" "i2c 660" "$bus"; done
is "$(owner "/dev/iio:device0")" "gpio 660" iio:device0
is "$(owner /sys/class/pwm/pwmchip0/export)" "gpio 220" export
# The group may export a channel, and use it.
usermod -aG gpio klippy
klippy sh -c 'echo 2 >/sys/class/pwm/pwmchip0/export'
until_true 5 klippy sh -c 'echo 1000000 >/sys/class/pwm/pwmchip0/pwm2/period'
klippy sh -c 'echo 2 >/sys/class/pwm/pwmchip0/unexport'
thermometer=$(echo /sys/bus/w1/devices/28-* | cut -d ' ' -f 1)
is "$(stat -c %G "$thermometer/w1_slave")" gpio w1_slave
klippy head -c 1 "$thermometer/w1_slave" >/dev/null
gpasswd -d klippy gpio
# A chip that is plugged in later.
chips later
until_true 5 test -c /dev/gpiochip1
udevadm settle
is "$(owner /dev/gpiochip1)" "gpio 660" gpiochip1
echo 0 >/sys/kernel/config/gpio-sim/later/live
udevadm test --action=add /sys/class/misc/watchdog 2>&1 | grep -i 'pinion-mcu.rules'
if udevadm test --action=add /sys/class/misc/watchdog 2>&1 | grep -i 'pinion-mcu.rules.*\(invalid\|unknown\|error\)'; then false; fi
