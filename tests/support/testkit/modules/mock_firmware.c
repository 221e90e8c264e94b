// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * The firmware of a Raspberry Pi, as far as upstream's raspberrypi-hwmon asks it,
 * and that driver. It asks every two seconds, so only the test of it loads this.
 *
 * /sys/module/mock_firmware/parameters/throttled has the firmware's bits.
 */
#include <linux/module.h>
#include <linux/platform_device.h>
#include <soc/bcm2835/raspberrypi-firmware.h>

static uint throttled;
module_param(throttled, uint, 0644);

static int mock_property(struct rpi_firmware *fw, u32 tag, void *data, size_t len)
{
	*(u32 *)data = READ_ONCE(throttled);
	return 0;
}

#define rpi_firmware_property mock_property
#undef module_platform_driver
#define module_platform_driver(driver)
#include "upstream/raspberrypi-hwmon.c"

static struct platform_device *mock_firmware_device;

static int __init mock_firmware_init(void)
{
	int err = platform_driver_register(&rpi_hwmon_driver);

	if (err)
		return err;
	mock_firmware_device = platform_device_register_simple("raspberrypi-hwmon", -1, NULL, 0);
	if (!IS_ERR(mock_firmware_device))
		return 0;
	platform_driver_unregister(&rpi_hwmon_driver);
	return PTR_ERR(mock_firmware_device);
}
module_init(mock_firmware_init);

static void __exit mock_firmware_exit(void)
{
	platform_device_unregister(mock_firmware_device);
	platform_driver_unregister(&rpi_hwmon_driver);
}
module_exit(mock_firmware_exit);
