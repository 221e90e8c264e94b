# An axis homes through the link.
fresh
systemctl start pinion-mcu
echo pull-down >"$CHIP/sim_gpio6/pull"
klippy /share/host home $LINK >/run/home 2>&1 &
host=$!
until_true 20 grep -q '^homing' /run/home
sleep 1
echo pull-up >"$CHIP/sim_gpio6/pull"
wait $host || { cat /run/home; false; }
cat /run/home
