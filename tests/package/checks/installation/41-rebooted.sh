# The first host after the boot finds the names of chips with late drivers.
until_true 60 is_active pinion-mcu
until_true 30 is_active test-chips
identifies $LINK HEATER
# The link is not removed with the old files in /tmp.
touch -h -d '100 days ago' $LINK
systemd-tmpfiles --clean
identifies
