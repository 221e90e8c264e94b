# SPDX-License-Identifier: GPL-3.0-or-later
"""Pinion in KIAUH's menu of extensions: copy this folder to kiauh/extensions/pinion of KIAUH.

The package comes from apt. If pinion.sources and pinion.asc are in this folder, as in a release, they become apt's
source for it.
"""

import getpass
import os
from pathlib import Path
from subprocess import CalledProcessError, run
from typing import List

from core.logger import DialogType, Logger
from extensions.base_extension import BaseExtension
from utils.input_utils import get_confirm

PACKAGE = "pinion-mcu"
SERVICE = "pinion-mcu.service"
# Files beside this one, and where apt reads them.
SOURCE = {
    "pinion.asc": Path("/etc/apt/keyrings/pinion.asc"),
    "pinion.sources": Path("/etc/apt/sources.list.d/pinion.sources"),
}


def sudo(*command: str) -> None:
    """Runs a command as root, with its output on the terminal and without questions."""
    run(["sudo", "env", "DEBIAN_FRONTEND=noninteractive", *command], check=True)


def is_active(service: str) -> bool:
    return run(["systemctl", "--quiet", "is-active", service]).returncode == 0


class PinionExtension(BaseExtension):
    def install_extension(self, **kwargs) -> None:
        Logger.print_status("Installing Pinion ...")
        try:
            here = Path(__file__).resolve().parent
            if all(here.joinpath(name).exists() for name in SOURCE):
                for name, place in SOURCE.items():
                    sudo("install", "-D", "-m", "644", str(here.joinpath(name)), str(place))
            sudo("apt-get", "update")
            sudo("apt-get", "install", "-y", PACKAGE)
            # The terminal between the host and Pinion belongs to this group.
            sudo("usermod", "-aG", "tty", getpass.getuser())
            if is_active("klipper-mcu.service"):
                self.finish(
                    [
                        "Klipper's own klipper-mcu.service is in use and stays so.",
                        "docs/guide/migrate.md of Pinion says how to change over.",
                    ]
                )
                return
            if not get_confirm("Start Pinion now, and at every boot?", default_choice=True):
                self.finish([f"Start it later: sudo systemctl enable --now {PACKAGE}"])
                return
            sudo("systemctl", "enable", "--now", SERVICE)
            self.finish(
                [
                    "Log out and in again, then restart Klipper when no print runs.",
                    "\n\n",
                    "sudo pinion add connects an accelerometer or another device.",
                    "sudo pinion doctor checks the installation.",
                ]
            )
        except CalledProcessError as error:
            self.failed("install", error)

    def update_extension(self, **kwargs) -> None:
        Logger.print_status("Updating Pinion ...")
        try:
            sudo("apt-get", "update")
            sudo("apt-get", "install", "-y", "--only-upgrade", PACKAGE)
            if not is_active(SERVICE):
                self.finish(["Pinion is up to date."])
                return
            Logger.print_info("The running Pinion goes on as it was. A restart shuts the MCU down.")
            if get_confirm("Does no print run, and restart Pinion now?", default_choice=False):
                sudo("systemctl", "restart", SERVICE)
                self.finish(["Pinion is up to date. Run FIRMWARE_RESTART in the host."])
            else:
                self.finish([f"Restart it when no print runs: sudo systemctl restart {PACKAGE}"])
        except CalledProcessError as error:
            self.failed("update", error)

    def remove_extension(self, **kwargs) -> None:
        Logger.print_dialog(
            DialogType.ATTENTION,
            ["This stops Pinion. Its outputs go to their shutdown values, and a print ends."],
        )
        if not get_confirm("Remove Pinion?", default_choice=False):
            return
        try:
            sudo("apt-get", "remove", "-y", PACKAGE)
            for place in SOURCE.values():
                if os.path.lexists(place):
                    sudo("rm", str(place))
            self.finish(["Remove [mcu host] and its pins from printer.cfg, or Klipper does not start."])
        except CalledProcessError as error:
            self.failed("remove", error)

    @staticmethod
    def finish(lines: List[str]) -> None:
        Logger.print_dialog(DialogType.SUCCESS, lines)

    @staticmethod
    def failed(what: str, error: CalledProcessError) -> None:
        command = " ".join(error.cmd)
        Logger.print_error(f"Pinion: could not {what}: {command}: exit status {error.returncode}")
        if what == "install":
            Logger.print_info("apt needs a source of the package: see docs/guide/install.md of Pinion.")
