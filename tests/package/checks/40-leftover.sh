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
said | grep "$LINK exists and is no symbolic link: remove it" >/dev/null
is "$(cat $LINK)" 'a letter'
sleep 25
is "$(cat $LINK)" 'a letter'
rm $LINK
until_true 10 is_active pinion-mcu
identifies
# Files of other users are not removed.
systemctl stop pinion-mcu
runuser -u stranger -- sh -c "echo FORCE_SHUTDOWN >$LINK"
not systemctl start pinion-mcu
rm $LINK
until_true 10 is_active pinion-mcu
