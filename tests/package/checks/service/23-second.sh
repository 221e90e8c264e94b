# A second program does not take the link of a running one, whatever user starts it. The service does not take it
# either.
fresh
systemctl start pinion-mcu
words="$LINK leads to /dev/pts/.*, which Pinion serves (process $(pid)): stop it (sudo systemctl stop pinion-mcu), or"
refused() {
    not timeout 20 "$@" >/run/refused 2>&1
    grep "$words" /run/refused || { cat /run/refused; false; }
}
refused pinion run --board sim
refused pinion sim --show
# The same is true for a user who may neither query the service nor inspect its process.
refused runuser -u klippy -- pinion run --board sim
refused runuser -u stranger -- pinion run --board sim
is "$(readlink $LINK)" /run/pinion/klipper_host_mcu "the link"
identifies
systemctl stop pinion-mcu

mark
pinion run --board sim >/run/second 2>&1 &
second=$!
until_true 10 [ -L $LINK ]
before=$(readlink $LINK)
not systemctl start pinion-mcu
said | grep "$LINK leads to $before, which another program serves: stop it"
is "$(readlink $LINK)" "$before" "the link"
kill -9 $second
until_true 10 is_active pinion-mcu
identifies
