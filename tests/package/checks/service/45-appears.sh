# A chip that appears after Pinion's start is available to the next host, without a restart.
fresh
systemctl start pinion-mcu
before=$(pid)
not identifies $LINK extra-LINE
chips extra
# The kernel makes the device, and udev gives it to its group a moment later.
udevadm settle
identifies $LINK extra-LINE
is "$(pid)" "$before" "the process"
echo 0 >/sys/kernel/config/gpio-sim/extra/live
not identifies $LINK extra-LINE
