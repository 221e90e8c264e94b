# SPDX-License-Identifier: GPL-3.0-or-later
# `make` alone lists the commands.

# Looked for at each use: scripts/system-packages may have installed it just now.
CARGO ?= $(shell command -v cargo || echo "$$HOME/.cargo/bin/cargo")
CARGO_TARGET_DIR ?= target
PINION = $(CARGO_TARGET_DIR)/release/pinion
# Beside it: the simulated printer.
PINION_SIM = $(dir $(PINION))pinion-sim
CLOCK = $(dir $(PINION))deps/libpinion_clock.so
# Options for `pinion sim`, such as ARGS="-I /tmp/klipper_host_sim".
ARGS ?=
# Root may run in real time: what else the computer does then delays no step.
REALTIME = $(if $(filter 0,$(shell id -u)),-r)

PREFIX ?= /usr/local
DESTDIR ?=
UNITDIR ?= $(PREFIX)/lib/systemd/system
USERUNITDIR ?= $(PREFIX)/lib/systemd/user
SYSUSERSDIR ?= $(PREFIX)/lib/sysusers.d
TMPFILESDIR ?= $(PREFIX)/lib/tmpfiles.d
# udev does not look below /usr/local.
UDEVDIR ?= $(if $(filter /usr,$(PREFIX)),/usr/lib/udev,/etc/udev)/rules.d
MANDIR ?= $(PREFIX)/share/man
# The pages that messages name.
DOCDIR ?= $(PREFIX)/share/doc/pinion-mcu
LIBDIR = $(PREFIX)/lib/pinion-mcu
BASHDIR ?= $(PREFIX)/share/bash-completion/completions
ZSHDIR ?= $(PREFIX)/share/zsh/site-functions
FISHDIR ?= $(PREFIX)/share/fish/vendor_completions.d
# A program that runs here, to ask for the shells' completions: not PINION where that is of another architecture.
COMPLETER ?= $(PINION)
DEB_FOLDER ?= $(CARGO_TARGET_DIR)/deb
RELEASE_FOLDER ?= $(CARGO_TARGET_DIR)/pinion-mcu-release
IMAGE_FOLDER ?= $(CARGO_TARGET_DIR)/image

# A computer of 32 bits.
SMALL = armv7-unknown-linux-gnueabihf

export CARGO_TARGET_DIR

.DEFAULT_GOAL = help
.PHONY: help run demo mainsail test test-all test-programs test-drivers test-slow test-slow-programs test-slow-drivers
.PHONY: test-kernel test-raspberry-pi test-package test-bare
.PHONY: figures klippy soak soak-real fuzz coverage mutants
.PHONY: sanitize bench check build install install-program install-sim install-system uninstall deb release image clean

# They install what is missing, Rust too.
PACKAGES = $(addprefix system-packages-,build mainsail vm deb release image system stress check fuzz coverage)
.PHONY: $(PACKAGES)
$(PACKAGES): system-packages-%:
	@CARGO='$(CARGO)' scripts/system-packages $*

help:
	@echo 'make run           build, home and heat a simulated printer, then serve a real host until Ctrl-C'
	@echo 'make demo          the same without serving; fails if anything shown was not right'
	@echo 'make mainsail      the simulated printer with Klipper, Moonraker and Mainsail, until Ctrl-C (FOLDER=$(FOLDER))'
	@echo 'make test          the tests for each change, with those on real kernel drivers in a virtual machine'
	@echo 'make test-all      all tests (tests/README.md): the former, make check and what takes long; as root also'
	@echo '                   the package, and with KLIPPER_DIR=~/klipper a real klippy'
	@echo 'make test-slow     tests in which heaters and motors take their real time, minutes of printing with faults,'
	@echo '                   the pictures of the camera, and on drivers the rarer ones'
	@echo 'make test-kernel   all tests on real kernel drivers, on two kernels'
	@echo 'make figures       figures of the program in that virtual machine (docs/develop/performance.md)'
	@echo 'make test-package  the package installed in a booted Debian 12 with systemd (as root)'
	@echo 'make test-bare     make run and make test in bare root folders of Debian 12 and 13 (as root; hours)'
	@echo 'make test-raspberry-pi'
	@echo '                   a smoke test on an emulated Raspberry Pi 3 and 4 (installs a cross compiler)'
	@echo 'make soak          a day of printing with faults, in virtual time: 10 to 20 minutes (SECONDS=86400 SEED=)'
	@echo 'make soak-real     an hour of the real program on a busy computer (MINUTES=60 WORKERS=1)'
	@echo 'make fuzz          random bytes for everything that reads what others wrote: each target for'
	@echo '                   SECONDS=60, or all for TOTAL=600; only one with TARGET=link'
	@echo 'make coverage      how many lines the tests reach (ARGS="-p pinion-firmware" for some of them;'
	@echo '                   LAB=1 also those in the virtual machine)'
	@echo 'make mutants       do the tests notice if the code is changed? (PACKAGE=pinion-firmware SHARD=7/30)'
	@echo 'make sanitize      what threads share, in all orders; tests with sanitizers'
	@echo 'make bench         the benchmarks'
	@echo 'make check         formatting, lints, documentation, man pages, licenses, sizes, what the package has'
	@echo 'make build         the programs: $(PINION) and pinion-sim'
	@echo 'make install       program, service, udev rules and man pages (PREFIX=$(PREFIX) DESTDIR=)'
	@echo 'make deb           a Debian package in $(DEB_FOLDER); for a Raspberry Pi: ARCH=arm64 or ARCH=armhf,'
	@echo '                   in $(DEB_FOLDER)/arm64 or $(DEB_FOLDER)/armhf'
	@echo 'make release       packages for amd64, arm64 and armhf, checksums and notes in $(RELEASE_FOLDER);'
	@echo '                   with KEY=NAME (of gpg) also an apt repository, for users at URL=https://...'
	@echo 'make image         container images for amd64 and arm64, as OCI archives in $(IMAGE_FOLDER)'
	@echo 'make clean         remove what was built'

run: build
	@'$(PINION)' sim $(REALTIME) $(ARGS)

demo: build
	@'$(PINION)' sim --demo $(REALTIME) $(ARGS)

# With all that it downloads.
FOLDER ?= $(CARGO_TARGET_DIR)/mainsail
mainsail: system-packages-mainsail build
	@PINION='$(PINION)' scripts/mainsail '$(FOLDER)'

build: system-packages-build
	@'$(CARGO)' build --release --locked --quiet --package pinion-mcu --package pinion-sim

# The virtual machines are such computers.
EMULATES = $(filter x86_64,$(shell uname -m))
# Time in the virtual machines counts instructions, so what else the computer does may go first. It does not get all:
# beside a few programs that compute, the lowest priority would leave them a tenth of a processor.
TEST_KERNEL = nice -n 5 '$(CARGO)' test --locked --test kernel
# `make test-slow` has faults, refusals and old kernels. `make test-kernel` has the drivers and mocks themselves, and a
# hundred thousand frames of a CAN bus.
DRIVERS = --flavour stock --skip selftest:: --skip slow:: --skip floods::

# Most tests of the programs wait, and most of those on drivers compute: both take hardly longer than one of them.
test: system-packages-vm
	'$(CARGO)' test --locked --no-run
ifdef EMULATES
	'$(CARGO)' test --locked --no-run --test kernel --test kernel_guest
	@$(MAKE) --no-print-directory -j2 test-programs test-drivers
else
	@$(MAKE) --no-print-directory test-programs
	@echo 'NOT RUN: the tests in the virtual machine, which need an x86-64 computer' >&2
endif

# Fewer random cases of each property than proptest's 256, which `cargo test` alone has.
test-programs:
	PROPTEST_CASES=$${PROPTEST_CASES:-32} '$(CARGO)' test --locked

# Its lines would stand among those of the other tests.
test-slow-drivers: DRIVERS = --flavour stock slow::
test-drivers test-slow-drivers:
	@log=$$(mktemp) && status=0 && { $(TEST_KERNEL) -- $(DRIVERS) >"$$log" 2>&1 || status=$$?; } && \
	    cat "$$log" && rm "$$log" && exit $$status

# One after the other: each has its own times.
test-all: export PROPTEST_CASES = 256
test-all: check test test-slow test-kernel figures
	@$(MAKE) --no-print-directory fuzz TOTAL=60
	@if [ $$(id -u) = 0 ]; then $(MAKE) --no-print-directory test-package; \
	else echo 'NOT RUN: make test-package, which takes root' >&2; fi
	@$(MAKE) --no-print-directory klippy

# The demonstration waits for heaters and motors most of the time.
test-slow: $(if $(EMULATES),system-packages-vm)
	'$(CARGO)' test --locked --no-run --test program --test pinion_sim --test soak
	'$(CARGO)' test --locked --no-run --package pinion-camera
ifdef EMULATES
	'$(CARGO)' test --locked --no-run --test kernel --test kernel_guest
endif
	@$(MAKE) --no-print-directory -j2 test-slow-programs $(if $(EMULATES),test-slow-drivers)

test-slow-programs:
	'$(CARGO)' test --locked --test program --test pinion_sim -- --ignored slow::cut::
	'$(CARGO)' test --locked --test soak -- --ignored
	'$(CARGO)' test --locked --package pinion-camera
	@# In real time, so that it would delay the others.
	'$(CARGO)' test --locked --test program --test pinion_sim -- --ignored slow::demonstration:: --test-threads=1

klippy:
	@# First what no load can delay; real time has the computer for itself.
	@if [ -n "$$KLIPPER_DIR" ]; then '$(CARGO)' test --locked --test klippy -- --skip real_time && \
	    '$(CARGO)' test --locked --test klippy -- real_time --test-threads=1; \
	else echo 'NOT RUN: the tests with a real klippy, which take KLIPPER_DIR=~/klipper' >&2; fi

test-kernel: system-packages-vm
	$(TEST_KERNEL)

figures: system-packages-vm
	$(TEST_KERNEL) --release -- figures

test-raspberry-pi: system-packages-build
	'$(CARGO)' test --locked --test raspberry_pi

SUITES ?= bookworm trixie
test-bare:
	@for suite in $(SUITES); do scripts/bare $$suite || exit 1; done

# Such as 'service/ installation/' or 'upgrade' (docs/develop/test-package.md).
CHECKS ?=
test-package: system-packages-system
	@# pinion-sim is in the package, too.
	'$(CARGO)' test --locked --no-run --test package --test pinion_sim
	'$(CARGO)' test --locked --test package -- $(CHECKS)

SECONDS ?= 86400
# Each run has its own faults. The test prints its seed if it fails.
SEED ?= $(shell date +%s)
soak: system-packages-build
	PINION_SOAK_SECONDS=$(SECONDS) PINION_SOAK_SEED=$(SEED) '$(CARGO)' test --locked --test soak -- --ignored --nocapture

MINUTES ?= 60
# Workers of stress-ng for each kind of load.
WORKERS ?= 1
soak-real: system-packages-stress
	PINION_SOAK_MINUTES=$(MINUTES) PINION_SOAK_WORKERS=$(WORKERS) \
	    '$(CARGO)' test --locked --test program soak:: -- --ignored --nocapture

# Seconds for each target, unless TOTAL says how long all targets together may take.
fuzz: SECONDS = 60
TOTAL ?=
TARGET ?=
fuzz: system-packages-fuzz
	@CARGO='$(CARGO)' scripts/fuzz $(if $(TOTAL),--total $(TOTAL),$(SECONDS)) $(TARGET)

# LAB=1 runs the tests in the virtual machine, too.
LAB ?=
coverage: system-packages-coverage $(if $(LAB),system-packages-vm)
	@CARGO='$(CARGO)' scripts/coverage $(if $(LAB),--lab) $(ARGS)

PACKAGE ?= pinion-firmware
# A part of the mutants, such as 7/30: each 30th of them.
SHARD ?=
# More options of cargo-mutants, such as MUTANTS='-f crates/runtime/src/**', and those of cargo test. any_commands is slow.
MUTANTS ?=
TESTS ?= -- --skip any_commands
# Random tests have the same few cases for each mutant, and leave no files.
mutants: system-packages-build
	@'$(CARGO)' mutants --version >/dev/null 2>&1 || \
	    { echo 'There is no cargo-mutants. Install it: cargo install --locked cargo-mutants' >&2; exit 1; }
	@mkdir -p '$(CARGO_TARGET_DIR)'
	env -u CARGO_TARGET_DIR PROPTEST_CASES=16 PROPTEST_RNG_SEED=1 PROPTEST_MAX_SHRINK_ITERS=0 \
	    PROPTEST_DISABLE_FAILURE_PERSISTENCE=1 '$(CARGO)' mutants --package $(PACKAGE) --output '$(CARGO_TARGET_DIR)' \
	    $(if $(SHARD),--sharding round-robin --shard $(SHARD)) $(MUTANTS) -- $(TESTS)

sanitize: system-packages-build
	@CARGO='$(CARGO)' scripts/sanitize

bench: system-packages-build
	'$(CARGO)' bench --locked --package pinion-benches

check: system-packages-check
	'$(CARGO)' fmt --all --check
	@# With the parts of the fuzz targets in the program. For 32 bits, if Rust can compile for them: the tests compile
	@# everything for 64 bits anyway. Nothing is linked, so there is no libFuzzer, and no C compiler for them. What is a
	@# cast on one may be none on the other.
	@small= && casts= && if rustup target list --installed 2>/dev/null | grep -qx $(SMALL); then \
	    small='--target $(SMALL)' && casts='-A clippy::unnecessary_cast' && export CUSTOM_LIBFUZZER_PATH=/none/libfuzzer.a \
	    $(addsuffix _$(subst -,_,$(SMALL))=true,CC AR); \
	else echo 'NOT RUN: the check for 32 bits, which needs: rustup target add $(SMALL)' >&2; fi; \
	set -ex; '$(CARGO)' clippy --locked --workspace --all-targets $$small -- -D warnings --cfg fuzzing $$casts; \
	export RUSTDOCFLAGS='-D warnings -A rustdoc::private_intra_doc_links'; \
	'$(CARGO)' doc --locked --no-deps --document-private-items --quiet $$small
	@# The programs of the tests: those built for themselves would have other features of some crates.
	'$(CARGO)' test --locked --quiet --no-run
	CARGO='$(CARGO)' scripts/check-dependencies
	scripts/check-size
	scripts/check-man '$(CARGO_TARGET_DIR)/debug/pinion'
	scripts/check-deb '$(CARGO_TARGET_DIR)/debug/pinion'

# Root installs what was built before: no compiler runs as root.
install: install-program install-sim install-system

install-program:
	@test -x '$(PINION)' || { echo 'There is nothing to install yet: run make build first.' >&2; exit 1; }
	install -D -m 755 '$(PINION)' $(DESTDIR)$(PREFIX)/bin/pinion
	install -D -m 644 man/pinion.1 $(DESTDIR)$(MANDIR)/man1/pinion.1
	install -D -m 644 man/pinion-mcu.service.8 $(DESTDIR)$(MANDIR)/man8/pinion-mcu.service.8
	install -d $(DESTDIR)$(DOCDIR)/guide
	install -m 644 docs/guide/*.md $(DESTDIR)$(DOCDIR)/guide
	install -D -m 755 systemd/link $(DESTDIR)$(LIBDIR)/link
	install -D -m 755 systemd/usb-gadget $(DESTDIR)$(LIBDIR)/usb-gadget
	install -D -m 644 systemd/can.conf $(DESTDIR)$(PREFIX)/share/pinion-mcu/can.conf
	install -d $(DESTDIR)$(BASHDIR) $(DESTDIR)$(ZSHDIR) $(DESTDIR)$(FISHDIR)
	'$(COMPLETER)' completions bash >$(DESTDIR)$(BASHDIR)/pinion
	'$(COMPLETER)' completions zsh >$(DESTDIR)$(ZSHDIR)/_pinion
	'$(COMPLETER)' completions fish >$(DESTDIR)$(FISHDIR)/pinion.fish
	chmod 644 $(DESTDIR)$(BASHDIR)/pinion $(DESTDIR)$(ZSHDIR)/_pinion $(DESTDIR)$(FISHDIR)/pinion.fish

# The simulated printer, for computers without pins, too.
install-sim:
	install -D -m 755 '$(PINION_SIM)' $(DESTDIR)$(PREFIX)/bin/pinion-sim
	install -D -m 644 '$(CLOCK)' $(DESTDIR)$(PREFIX)/lib/pinion-sim/libpinion_clock.so
	install -D -m 644 man/pinion-sim.1 $(DESTDIR)$(MANDIR)/man1/pinion-sim.1
	install -d $(DESTDIR)$(BASHDIR) $(DESTDIR)$(ZSHDIR) $(DESTDIR)$(FISHDIR)
	'$(COMPLETER)' sim completions bash >$(DESTDIR)$(BASHDIR)/pinion-sim
	'$(COMPLETER)' sim completions zsh >$(DESTDIR)$(ZSHDIR)/_pinion-sim
	'$(COMPLETER)' sim completions fish >$(DESTDIR)$(FISHDIR)/pinion-sim.fish
	chmod 644 $(DESTDIR)$(BASHDIR)/pinion-sim $(DESTDIR)$(ZSHDIR)/_pinion-sim $(DESTDIR)$(FISHDIR)/pinion-sim.fish

install-system:
	install -d $(DESTDIR)$(UNITDIR)
	for unit in pinion-mcu.service pinion-mcu@.service pinion-usb-gadget.service; do \
	    sed 's|/usr/bin/pinion|$(PREFIX)/bin/pinion|; s|/usr/lib/pinion-mcu|$(LIBDIR)|' systemd/$$unit \
	        >$(DESTDIR)$(UNITDIR)/$$unit && chmod 644 $(DESTDIR)$(UNITDIR)/$$unit || exit 1; \
	done
	install -d $(DESTDIR)$(USERUNITDIR)
	sed 's|/usr/bin/pinion|$(PREFIX)/bin/pinion|' systemd/pinion-link@.service \
	    >$(DESTDIR)$(USERUNITDIR)/pinion-link@.service && chmod 644 $(DESTDIR)$(USERUNITDIR)/pinion-link@.service
	install -D -m 644 systemd/pinion-mcu.sysusers $(DESTDIR)$(SYSUSERSDIR)/pinion-mcu.conf
	install -D -m 644 systemd/pinion-mcu.tmpfiles $(DESTDIR)$(TMPFILESDIR)/pinion-mcu.conf
	install -D -m 644 udev/60-pinion-mcu.rules $(DESTDIR)$(UDEVDIR)/60-pinion-mcu.rules
	test -e $(DESTDIR)/etc/pinion/pinion.toml || \
	    install -D -m 644 systemd/pinion.toml $(DESTDIR)/etc/pinion/pinion.toml
ifeq ($(DESTDIR),)
	systemd-sysusers $(SYSUSERSDIR)/pinion-mcu.conf
	-systemctl daemon-reload
	-udevadm control --reload && udevadm trigger --action=change --subsystem-match=gpio --subsystem-match='*gpiomem*' \
	    --subsystem-match=spidev --subsystem-match=i2c-dev --subsystem-match=iio --subsystem-match=pwm \
	    --subsystem-match=w1 && udevadm trigger --action=change --sysname-match='watchdog*'
	@echo 'Installed. Start it, now and at every boot: systemctl enable --now pinion-mcu'
endif

uninstall:
ifeq ($(DESTDIR),)
	-systemctl disable --now pinion-mcu pinion-usb-gadget
	-for unit in $$(systemctl list-units --all --plain --no-legend 'pinion-mcu@*.service' | cut -d ' ' -f 1); do \
	    systemctl disable --now $$unit; \
	done
endif
	rm -rf $(DESTDIR)$(DOCDIR)/guide $(DESTDIR)$(PREFIX)/lib/pinion-sim
	-rmdir --ignore-fail-on-non-empty $(DESTDIR)$(DOCDIR)
	rm -f $(DESTDIR)$(PREFIX)/bin/pinion $(DESTDIR)$(PREFIX)/bin/pinion-sim $(DESTDIR)$(MANDIR)/man1/pinion-sim.1 \
	    $(DESTDIR)$(BASHDIR)/pinion-sim $(DESTDIR)$(ZSHDIR)/_pinion-sim $(DESTDIR)$(FISHDIR)/pinion-sim.fish \
	    $(DESTDIR)$(UNITDIR)/pinion-mcu.service \
	    $(DESTDIR)$(UNITDIR)/pinion-mcu@.service $(DESTDIR)$(UNITDIR)/pinion-usb-gadget.service \
	    $(DESTDIR)$(USERUNITDIR)/pinion-link@.service \
	    $(DESTDIR)$(LIBDIR)/link $(DESTDIR)$(LIBDIR)/usb-gadget $(DESTDIR)$(BASHDIR)/pinion \
	    $(DESTDIR)$(PREFIX)/share/pinion-mcu/can.conf \
	    $(DESTDIR)$(ZSHDIR)/_pinion $(DESTDIR)$(FISHDIR)/pinion.fish \
	    $(DESTDIR)$(SYSUSERSDIR)/pinion-mcu.conf $(DESTDIR)$(TMPFILESDIR)/pinion-mcu.conf \
	    $(DESTDIR)$(UDEVDIR)/60-pinion-mcu.rules $(DESTDIR)/etc/default/pinion-mcu \
	    $(DESTDIR)$(MANDIR)/man1/pinion.1 $(DESTDIR)$(MANDIR)/man8/pinion-mcu.service.8 \
	    $(DESTDIR)/etc/pinion/pinion.toml
	test ! -d $(DESTDIR)/etc/pinion || rmdir --ignore-fail-on-non-empty $(DESTDIR)/etc/pinion
	-rmdir $(DESTDIR)$(LIBDIR) $(DESTDIR)$(PREFIX)/share/pinion-mcu
ifeq ($(DESTDIR),)
	rm -rf /run/pinion /var/lib/pinion
	-systemctl daemon-reload
	-udevadm control --reload
endif

ARCH ?=
# Rust is rustup's, and dpkg does not know it: -d leaves the build dependencies to us.
deb: system-packages-deb
	@scripts/build-deb '$(DEB_FOLDER)' $(ARCH)

# The secret key of gpg that signs the apt repository, and where users find it.
KEY ?=
URL ?=
release: system-packages-release
	@scripts/release '$(RELEASE_FOLDER)' '$(KEY)' '$(URL)'

IMAGE_ARCHS ?= amd64 arm64
image: system-packages-image
	@for arch in $(IMAGE_ARCHS); do \
	    scripts/build-deb '$(IMAGE_FOLDER)/deb' $$arch >&2 && \
	    deb=$$(find '$(IMAGE_FOLDER)/deb' -name "pinion-mcu_*_$$arch.deb") && \
	    scripts/image '$(IMAGE_FOLDER)' "$$deb" || exit 1; \
	done; ls -l '$(IMAGE_FOLDER)'/*.tar

clean:
	'$(CARGO)' clean
