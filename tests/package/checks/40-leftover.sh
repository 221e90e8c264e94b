# A file in the link's place: what Klipper's own service leaves there is taken away, anything else is not,
# and once somebody has removed that the service comes up by itself, however long it took.
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
said | grep "$LINK exists and is no symbolic link: remove it" >/dev/null
is "$(cat $LINK)" 'a letter'
sleep 25
is "$(cat $LINK)" 'a letter'
rm $LINK
until_true 10 is_active pinion-mcu
identifies
# Nobody else has files removed that they put there.
systemctl stop pinion-mcu
runuser -u stranger -- sh -c "echo FORCE_SHUTDOWN >$LINK"
not systemctl start pinion-mcu
rm $LINK
until_true 10 is_active pinion-mcu
