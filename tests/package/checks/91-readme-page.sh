# The README, from the installation to the purge, on a machine that has nothing of it yet.
bare
page README.md
not dpkg -s pinion-mcu
