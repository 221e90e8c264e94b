# The README, from the installation to the purge, on a system without any part of it.
bare
page README.md
not dpkg -s pinion-mcu
