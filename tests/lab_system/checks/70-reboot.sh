# It is enabled, and the computer boots.
systemctl enable --now pinion-mcu
systemctl reboot
exit 77
