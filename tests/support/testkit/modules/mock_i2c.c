// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * An I2C adapter with four chips at 0x50 to 0x53, each a file of 256 registers:
 * the first byte of a write sets the register, the others fill, reads advance.
 * No other address acknowledges.
 *
 * In /sys/devices/platform/mock-i2c:
 *   sent             one line per write: "ADDRESS BYTE...", in hexadecimal
 *   change           written: "ADDRESS REGISTER VALUE", in hexadecimal: the chip
 *                    changes a register by itself, whatever the bus is at
 *   fail, delay_ms, delay_us   see mock_bus.h
 */
#include <linux/i2c.h>
#include <linux/module.h>
#include <linux/platform_device.h>

#include "mock_bus.h"

#define FIRST_ADDRESS 0x50
#define CHIPS 4
#define RECORDED_BYTES_MAX 256

struct mock_i2c {
	struct mock_bus bus;
	struct i2c_adapter adapter;
	u8 registers[CHIPS][256];
	u8 next_register[CHIPS];
};

static struct platform_device *mock_i2c_device;

static void mock_i2c_message(struct mock_i2c *mock, int chip, struct i2c_msg *msg)
{
	u8 *registers = mock->registers[chip];
	u8 *next = &mock->next_register[chip];
	char what[8];
	int i;

	if (msg->flags & I2C_M_RD) {
		for (i = 0; i < msg->len; i++)
			msg->buf[i] = registers[(*next)++];
		return;
	}
	scnprintf(what, sizeof(what), "%02x", msg->addr);
	mock_bus_record(&mock->bus, what, msg->buf,
			min_t(size_t, msg->len, RECORDED_BYTES_MAX));
	if (msg->len)
		*next = msg->buf[0];
	for (i = 1; i < msg->len; i++)
		registers[(*next)++] = msg->buf[i];
}

static int mock_i2c_transfer(struct i2c_adapter *adapter, struct i2c_msg *msgs,
			     int count)
{
	struct mock_i2c *mock = i2c_get_adapdata(adapter);
	int i, err;

	err = mock_bus_trouble(&mock->bus);
	if (err)
		return err;
	for (i = 0; i < count; i++) {
		int chip = msgs[i].addr - FIRST_ADDRESS;

		if (chip < 0 || chip >= CHIPS)
			return -ENXIO;
		mutex_lock(&mock->bus.lock);
		mock_i2c_message(mock, chip, &msgs[i]);
		mutex_unlock(&mock->bus.lock);
	}
	return count;
}

static u32 mock_i2c_functionality(struct i2c_adapter *adapter)
{
	return I2C_FUNC_I2C | I2C_FUNC_SMBUS_EMUL;
}

static const struct i2c_algorithm mock_i2c_algorithm = {
	.master_xfer = mock_i2c_transfer,
	.functionality = mock_i2c_functionality,
};

static ssize_t change_store(struct device *dev, struct device_attribute *attr,
			    const char *buf, size_t len)
{
	struct mock_i2c *mock = dev_get_drvdata(dev);
	unsigned int address, reg;
	u8 value;

	if (sscanf(buf, "%x %x %hhx", &address, &reg, &value) != 3 ||
	    address < FIRST_ADDRESS || address >= FIRST_ADDRESS + CHIPS || reg > 255)
		return -EINVAL;
	mutex_lock(&mock->bus.lock);
	mock->registers[address - FIRST_ADDRESS][reg] = value;
	mutex_unlock(&mock->bus.lock);
	return len;
}
static DEVICE_ATTR_WO(change);

static struct attribute *mock_i2c_attrs[] = {
	MOCK_BUS_ATTRS, &dev_attr_change.attr, NULL
};
ATTRIBUTE_GROUPS(mock_i2c);

static int mock_i2c_probe(struct platform_device *pdev)
{
	struct mock_i2c *mock = devm_kzalloc(&pdev->dev, sizeof(*mock), GFP_KERNEL);

	if (!mock)
		return -ENOMEM;
	mutex_init(&mock->bus.lock);
	platform_set_drvdata(pdev, mock);
	mock->adapter.owner = THIS_MODULE;
	mock->adapter.algo = &mock_i2c_algorithm;
	mock->adapter.dev.parent = &pdev->dev;
	strscpy(mock->adapter.name, "mock-i2c", sizeof(mock->adapter.name));
	i2c_set_adapdata(&mock->adapter, mock);
	return devm_i2c_add_adapter(&pdev->dev, &mock->adapter);
}

static struct platform_driver mock_i2c_driver = {
	.probe = mock_i2c_probe,
	.driver = { .name = "mock-i2c", .dev_groups = mock_i2c_groups },
};

static int __init mock_i2c_init(void)
{
	int err = platform_driver_register(&mock_i2c_driver);

	if (err)
		return err;
	mock_i2c_device = platform_device_register_simple("mock-i2c", -1, NULL, 0);
	if (!IS_ERR(mock_i2c_device))
		return 0;
	platform_driver_unregister(&mock_i2c_driver);
	return PTR_ERR(mock_i2c_device);
}
module_init(mock_i2c_init);

static void __exit mock_i2c_exit(void)
{
	platform_device_unregister(mock_i2c_device);
	platform_driver_unregister(&mock_i2c_driver);
}
module_exit(mock_i2c_exit);

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("I2C adapter with register files");
