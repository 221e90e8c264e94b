# A file in the link's place. The leftover of Klipper's own service is removed, but nothing else is. When somebody has
# removed another file, the service starts by itself, however long that takes.
fresh
systemctl stop pinion-mcu
for content in '' FORCE_SHUTDOWN; do
    echo $content >$LINK
    systemctl start pinion-mcu
    identifies
    systemctl stop pinion-mcu
done
mark
echo 'a letter' >$LINK
not systemctl start pinion-mcu
said | grep "$LINK exists but is not a symbolic link: remove it" >/dev/null
tried_again() { [ "$(systemctl show -P NRestarts pinion-mcu)" -gt 0 ]; }
until_true 20 tried_again
is "$(cat $LINK)" 'a letter'
# A failed start takes so long that the service never comes to its limit of starts.
limits() { systemctl show -P "$1" pinion-mcu | sed 's/^1min$/60/; s/s$//'; }
patience=$(sed -n 's/^PATIENCE=//p' /usr/lib/pinion-mcu/link)
[ $((($(limits RestartUSec) + patience) * $(limits StartLimitBurst))) -gt "$(limits StartLimitIntervalUSec)" ]
rm $LINK
until_true 10 is_active pinion-mcu
identifies
# Files of other users are not removed.
systemctl stop pinion-mcu
runuser -u stranger -- sh -c "echo FORCE_SHUTDOWN >$LINK"
not systemctl start pinion-mcu
rm $LINK
until_true 10 is_active pinion-mcu
