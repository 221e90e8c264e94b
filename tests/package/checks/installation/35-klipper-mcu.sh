# With Klipper's own service: starting one of them stops the other. Then that service with only its binary changed:
# Pinion takes its place, also through immediate stops and restarts.
cat >/etc/systemd/system/klipper-mcu.service <<'END'
[Unit]
Description=stands for Klipper's own
[Service]
ExecStart=/bin/sleep infinity
[Install]
WantedBy=multi-user.target
END
systemctl daemon-reload
fresh
systemctl start pinion-mcu
systemctl start klipper-mcu
not is_active pinion-mcu
systemctl start pinion-mcu
is "$(systemctl is-active klipper-mcu || true)" inactive
identifies

# Klipper's `make flash` starts its unit even if the unit is disabled, which stops Pinion. It does not if the unit was
# moved away as in docs/guide/migrate.md. doctor reports the unit.
systemctl enable pinion-mcu
flash() {
    install -D -m 755 /bin/sleep /run/flashed/klipper.elf
    bash /share/klipper/flash-linux.sh /run/flashed
}
doctor >/run/doctor
grep 'make flash starts it' /run/doctor
if [ -e /share/klipper/flash-linux.sh ]; then
    flash
    not is_active pinion-mcu
    systemctl stop klipper-mcu
    systemctl start pinion-mcu
fi
mv /etc/systemd/system/klipper-mcu.service /etc/systemd/system/klipper-mcu.service.before-pinion
systemctl daemon-reload
doctor >/run/doctor
not grep 'make flash starts it' /run/doctor
if [ -e /share/klipper/flash-linux.sh ]; then
    before=$(pid)
    flash
    is "$(pid)" "$before" "the process"
    identifies
fi
rm /etc/systemd/system/klipper-mcu.service.before-pinion
systemctl disable pinion-mcu
systemctl stop pinion-mcu

cat >/etc/systemd/system/klipper-mcu.service <<'END'
[Unit]
Description=Klipper's own, with the binary changed
[Service]
Type=simple
ExecStart=/usr/bin/pinion -r -I /tmp/klipper_host_mcu
ExecStop=/bin/sh -c 'echo FORCE_SHUTDOWN >/tmp/klipper_host_mcu'
ExecStop=/bin/sleep 1
TimeoutStopSec=2
Restart=always
RestartSec=5
END
systemctl daemon-reload
systemctl start klipper-mcu
until_true 10 identifies
# A start with an immediate restart: the stop writes before a link exists.
systemctl stop klipper-mcu

systemctl start klipper-mcu; systemctl restart klipper-mcu
until_true 15 identifies
systemctl stop klipper-mcu
echo FORCE_SHUTDOWN >$LINK
systemctl start klipper-mcu
until_true 15 identifies
systemctl stop klipper-mcu
rm -f /etc/systemd/system/klipper-mcu.service
systemctl daemon-reload
systemctl start pinion-mcu
identifies
