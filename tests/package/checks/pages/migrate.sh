# Klipper's own service runs, with a replacement for its program. Its user is also in the group tty. The package is
# already built.
bare
usermod -aG tty pi
instead 'make deb'
install -m 755 /bin/sleep /usr/local/bin/klipper_mcu
cat >/etc/systemd/system/klipper-mcu.service <<'UNIT'
[Unit]
Description=stands for Klipper's own
Before=klipper.service
ConditionFileIsExecutable=/usr/local/bin/klipper_mcu
[Install]
WantedBy=multi-user.target
[Service]
Type=simple
Environment=KLIPPER_HOST_MCU_SERIAL=/tmp/klipper_host_mcu
RemainAfterExit=yes
ExecStart=/usr/local/bin/klipper_mcu infinity
ExecStop=sh -c 'echo "FORCE_SHUTDOWN" > ${KLIPPER_HOST_MCU_SERIAL}'
ExecStop=sleep 1
TimeoutStopSec=2
Restart=always
RestartSec=5
UNIT
systemctl daemon-reload
systemctl enable --now klipper-mcu
page docs/guide/migrate.md
systemctl disable --now klipper-mcu
rm -rf /etc/systemd/system/klipper-mcu.service* /usr/local/bin/klipper_mcu $LINK
systemctl daemon-reload
