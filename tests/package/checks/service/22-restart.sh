# After a stop, a start, and five quick restarts it serves the same link. It also stops without a warning while outputs
# are in use.
light
mark
systemctl stop pinion-mcu
is_low 3
is "$(said pinion-mcu -p warning)" "" "a warning in the log"
systemctl start pinion-mcu
identifies
for _ in 1 2 3 4 5; do systemctl restart pinion-mcu; done
identifies
