# The first host after the boot finds the names of chips whose drivers came late.
until_true 60 is_active pinion-mcu
until_true 30 is_active test-chips
identifies $LINK HEATER
# It is not tidied away with what is old in /tmp.
touch -h -d '100 days ago' $LINK
systemd-tmpfiles --clean
identifies
