# Errors of a user: klippy shows them, and the journal and `pinion doctor` give the remedy.
. /share/klippy.sh
# klippy's user is not in the group. doctor prints the command, which this check runs unchanged.
sudo() { "$@"; }
install_klippy
configure
systemctl stop klipper
gpasswd -d klippy tty
fresh
systemctl restart pinion-mcu
rm -f $LOG
systemctl start klipper
until_true $START grep 'Unable to open .*port: .*Permission denied' $LOG
not pinion doctor >/run/doctor
grep -A 1 "klippy, klippy's user" /run/doctor
remedy=$(sed -n "/klippy, klippy's user/{n;s/^ *-> //p}" /run/doctor)
eval "$remedy"
until_state ready

# A chip that does not exist: the journal lists the chips that exist.
mark
sed -i 's|^pin: lab/gpio14|pin: gpiochip7/gpio3|' $CONFIG
gcode RESTART || true
until_true $START says 'GPIO chip device not found'
why
said | grep -i 'gpiochip7'
configure
firmware_restart
# A pin that klippy itself does not accept.
sed -i 's|^pin: lab/gpio14|pin: lab/gpio99|' $CONFIG
gcode RESTART || true
until_true $START says "'lab/gpio99' is not a valid pin name"
configure
firmware_restart
gcode 'SET_PIN PIN=light VALUE=1'
until_true 10 is_high 14
systemctl stop klipper
