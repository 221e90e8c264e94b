# The service is enabled, and the computer boots.
systemctl enable --now pinion-mcu
exit 77
