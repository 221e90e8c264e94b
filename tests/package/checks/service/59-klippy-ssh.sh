# A real klippy by the recipe "Over SSH" of docs/guide/another-computer.md: a key, the user's unit, and a connection that
# is lost. Both computers are this one, and a real sshd is between them.
. /share/klippy.sh
fresh
install_klippy
systemctl stop klipper
useradd -m -s /bin/bash -G tty far
UNIT=pinion-link@far@toolhead.local
SSH=/home/klippy/.ssh
RUN=/run/user/$(id -u klippy)
# systemd's PAM module would give this folder to the user's systemd. It is not installed, or each check with sudo took longer.
install -d /run/systemd/system/user@.service.d
printf '[Service]\nEnvironment=XDG_RUNTIME_DIR=/run/user/%%i\n' >/run/systemd/system/user@.service.d/runtime.conf
user() { klippy env HOME=/home/klippy XDG_RUNTIME_DIR="$RUN" "$@"; }
trap 'systemctl stop klipper ssh
    user systemctl --user disable --now $UNIT
    loginctl disable-linger klippy
    until_true 20 not is_active user@$(id -u klippy)
    rm -rf /run/systemd/system/user@.service.d $SSH /home/klippy/.config/systemd
    pkill -u far || true
    userdel -r far
    systemctl daemon-reload' EXIT
systemctl daemon-reload
systemctl start ssh pinion-mcu

user ssh-keygen -q -t ed25519 -N '' -f $SSH/id_ed25519
printf 'Host toolhead.local\n    HostName 127.0.0.1\n' | user tee $SSH/config >/dev/null
# In the place of ssh-copy-id, which asks for a password.
install -d -m 700 -o far -g far /home/far/.ssh
install -m 600 -o far -g far $SSH/id_ed25519.pub /home/far/.ssh/authorized_keys
user ssh -o StrictHostKeyChecking=accept-new far@toolhead.local true
# The key is for this only.
sed -i 's/^/restrict,command="pinion attach" /' /home/far/.ssh/authorized_keys

loginctl enable-linger klippy
until_true 30 user systemctl --user is-active default.target
user systemctl --user enable --now $UNIT
linked() { journalctl --sync; journalctl -q -o cat _SYSTEMD_USER_UNIT=$UNIT.service; }
connections() { [ "$(linked | grep -c 'connected to far@toolhead.local within')" -ge "$1" ]; }
until_true 30 connections 1
configure
sed -i "s|^serial: $LINK|serial: /tmp/klipper_host_toolhead|" $CONFIG
for_a_print
homes() { pull 6 up; gcode 'G28 X'; pull 6 down; is "$(of toolhead homed_axes)" x "what is homed"; }
systemctl start klipper
until_state ready
home_xy
print_a_while
echo "printed for $PRINT_S s: the motors are at $of_mcu; $(grep -o 'bytes_retransmit=[0-9]* bytes_invalid=[0-9]*' $LOG | tail -n 1)"
gcode 'SET_PIN PIN=light VALUE=1'
until_true 10 is_high 14
firmware_restart
homes

# The connection is killed.
pkill -KILL -u far -x sshd
until_state shutdown
says "Lost communication with MCU 'mcu'"
until_true 30 connections 3
gcode RESTART || true
until_state ready
homes
linked | grep 'round trip to far@toolhead.local: '
