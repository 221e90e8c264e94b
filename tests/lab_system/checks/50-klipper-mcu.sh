# Beside Klipper's own service: to start one stops the other, either way. And that service with nothing
# but its binary changed: Pinion takes its place, through stops and restarts at once.
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
# A start and a restart at once: the stop writes before a link is there.
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
