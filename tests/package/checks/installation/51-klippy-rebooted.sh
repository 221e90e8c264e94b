# Both have started by themselves.
. /share/klippy.sh
until_state ready
pull 8 up
until_true 10 is_high 14
systemctl disable --now klipper
rm -r /etc/systemd/system/klipper.service /home/klippy/klipper $DATA
systemctl daemon-reload
