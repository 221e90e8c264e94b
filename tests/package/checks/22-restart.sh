# Stopped, started, and restarted five times quickly it serves the same link; it stops without a warning
# with outputs in use, too.
light
mark
systemctl stop pinion-mcu
is_low 3
is "$(said pinion-mcu -p warning)" "" "a warning in the log"
systemctl start pinion-mcu
identifies
for _ in 1 2 3 4 5; do systemctl restart pinion-mcu; done
identifies
