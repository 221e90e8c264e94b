// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * A 1-Wire master with two DS18B20 thermometers, 28-000000001001 and
 * 28-000000001002, for the stock w1_therm driver.
 *
 * In /sys/devices/platform/mock-w1:
 *   temperature   write "SENSOR MILLICELSIUS"; the next conversion measures it
 *   present       write "SENSOR 0" to take a sensor off the bus, 1 to put it back
 */
#include <asm/unaligned.h>
#include <linux/module.h>
#include <linux/platform_device.h>
#include <linux/w1.h>

#define SENSORS 2
#define FAMILY_DS18B20 0x28
#define FIRST_SERIAL 0x1001

#define MATCH_ROM 0x55
#define SKIP_ROM 0xcc
#define CONVERT 0x44
#define WRITE_SCRATCHPAD 0x4e
#define READ_SCRATCHPAD 0xbe

struct sensor {
	u8 rom[8];
	u8 scratchpad[9];
	int millicelsius;
	bool present;
};

struct mock_w1 {
	struct w1_bus_master master;
	struct sensor sensors[SENSORS];
	struct sensor *selected;
	/* What the next byte on the wire means. */
	enum {
		IDLE,
		ROM_COMMAND,
		ROM_BYTES,
		FUNCTION_COMMAND,
		SCRATCHPAD_OUT,
		SCRATCHPAD_IN,
	} state;
	u8 rom[8];
	int position;
};

static struct platform_device *mock_w1_device;

/* 0 is a presence pulse. */
static u8 mock_w1_reset_bus(void *data)
{
	struct mock_w1 *mock = data;
	int i;

	mock->state = ROM_COMMAND;
	mock->selected = NULL;
	for (i = 0; i < SENSORS; i++)
		if (READ_ONCE(mock->sensors[i].present))
			return 0;
	return 1;
}

static void mock_w1_select(struct mock_w1 *mock, const u8 *rom)
{
	int i;

	mock->state = IDLE;
	for (i = 0; i < SENSORS; i++) {
		struct sensor *sensor = &mock->sensors[i];

		if (!READ_ONCE(sensor->present))
			continue;
		if (rom && memcmp(sensor->rom, rom, sizeof(sensor->rom)))
			continue;
		mock->selected = sensor;
		mock->state = FUNCTION_COMMAND;
		return;
	}
}

static void mock_w1_function(struct mock_w1 *mock, u8 command)
{
	struct sensor *sensor = mock->selected;

	mock->position = 0;
	mock->state = IDLE;
	switch (command) {
	case CONVERT:
		/* Sixteenths of a degree. */
		put_unaligned_le16(READ_ONCE(sensor->millicelsius) * 16 / 1000,
				   sensor->scratchpad);
		break;
	case READ_SCRATCHPAD:
		sensor->scratchpad[8] = w1_calc_crc8(sensor->scratchpad, 8);
		mock->state = SCRATCHPAD_OUT;
		break;
	case WRITE_SCRATCHPAD:
		mock->state = SCRATCHPAD_IN;
		break;
	}
}

static void mock_w1_write_byte(void *data, u8 byte)
{
	struct mock_w1 *mock = data;

	switch (mock->state) {
	case ROM_COMMAND:
		mock->position = 0;
		if (byte == SKIP_ROM)
			mock_w1_select(mock, NULL);
		else
			mock->state = byte == MATCH_ROM ? ROM_BYTES : IDLE;
		break;
	case ROM_BYTES:
		mock->rom[mock->position++] = byte;
		if (mock->position == sizeof(mock->rom))
			mock_w1_select(mock, mock->rom);
		break;
	case FUNCTION_COMMAND:
		mock_w1_function(mock, byte);
		break;
	case SCRATCHPAD_IN:
		/* Alarm high, alarm low, and of the configuration its resolution. */
		mock->selected->scratchpad[2 + mock->position] =
			mock->position == 2 ? (byte & 0x60) | 0x1f : byte;
		if (++mock->position == 3)
			mock->state = IDLE;
		break;
	default:
		break;
	}
}

/* An idle wire reads as ones: powered, conversion done. */
static u8 mock_w1_read_byte(void *data)
{
	struct mock_w1 *mock = data;

	if (mock->state == SCRATCHPAD_OUT &&
	    mock->position < sizeof(mock->selected->scratchpad))
		return mock->selected->scratchpad[mock->position++];
	return 0xff;
}

static u8 mock_w1_touch_bit(void *data, u8 bit)
{
	return 1;
}

static void mock_w1_search(void *data, struct w1_master *master, u8 type,
			   w1_slave_found_callback found)
{
	struct mock_w1 *mock = data;
	int i;

	for (i = 0; i < SENSORS; i++)
		if (READ_ONCE(mock->sensors[i].present))
			found(master, get_unaligned_le64(mock->sensors[i].rom));
}

static ssize_t temperature_store(struct device *dev, struct device_attribute *attr,
				 const char *buf, size_t len)
{
	struct mock_w1 *mock = dev_get_drvdata(dev);
	int sensor, millicelsius;

	if (sscanf(buf, "%d %d", &sensor, &millicelsius) != 2 ||
	    sensor < 0 || sensor >= SENSORS)
		return -EINVAL;
	WRITE_ONCE(mock->sensors[sensor].millicelsius, millicelsius);
	return len;
}
static DEVICE_ATTR_WO(temperature);

static ssize_t present_store(struct device *dev, struct device_attribute *attr,
			     const char *buf, size_t len)
{
	struct mock_w1 *mock = dev_get_drvdata(dev);
	int sensor, present;

	if (sscanf(buf, "%d %d", &sensor, &present) != 2 ||
	    sensor < 0 || sensor >= SENSORS)
		return -EINVAL;
	WRITE_ONCE(mock->sensors[sensor].present, present);
	return len;
}
static DEVICE_ATTR_WO(present);

static struct attribute *mock_w1_attrs[] = {
	&dev_attr_temperature.attr, &dev_attr_present.attr, NULL
};
ATTRIBUTE_GROUPS(mock_w1);

static int mock_w1_probe(struct platform_device *pdev)
{
	/* 21 degrees, 12 bits, no alarms. */
	static const u8 scratchpad[9] = { 0x50, 0x01, 0x4b, 0x46, 0x7f, 0xff, 0x0c, 0x10 };
	struct mock_w1 *mock = devm_kzalloc(&pdev->dev, sizeof(*mock), GFP_KERNEL);
	int i;

	if (!mock)
		return -ENOMEM;
	platform_set_drvdata(pdev, mock);
	for (i = 0; i < SENSORS; i++) {
		struct sensor *sensor = &mock->sensors[i];

		sensor->rom[0] = FAMILY_DS18B20;
		put_unaligned_le32(FIRST_SERIAL + i, sensor->rom + 1);
		sensor->rom[7] = w1_calc_crc8(sensor->rom, 7);
		memcpy(sensor->scratchpad, scratchpad, sizeof(scratchpad));
		sensor->millicelsius = 21000;
		sensor->present = true;
	}
	mock->master.data = mock;
	mock->master.dev_id = "mock-w1";
	mock->master.reset_bus = mock_w1_reset_bus;
	mock->master.write_byte = mock_w1_write_byte;
	mock->master.read_byte = mock_w1_read_byte;
	mock->master.touch_bit = mock_w1_touch_bit;
	mock->master.search = mock_w1_search;
	return w1_add_master_device(&mock->master);
}

static int mock_w1_remove(struct platform_device *pdev)
{
	struct mock_w1 *mock = platform_get_drvdata(pdev);

	w1_remove_master_device(&mock->master);
	return 0;
}

static struct platform_driver mock_w1_driver = {
	.probe = mock_w1_probe,
	.remove = mock_w1_remove,
	.driver = { .name = "mock-w1", .dev_groups = mock_w1_groups },
};

static int __init mock_w1_init(void)
{
	int err = platform_driver_register(&mock_w1_driver);

	if (err)
		return err;
	mock_w1_device = platform_device_register_simple("mock-w1", -1, NULL, 0);
	if (!IS_ERR(mock_w1_device))
		return 0;
	platform_driver_unregister(&mock_w1_driver);
	return PTR_ERR(mock_w1_device);
}
module_init(mock_w1_init);

static void __exit mock_w1_exit(void)
{
	platform_device_unregister(mock_w1_device);
	platform_driver_unregister(&mock_w1_driver);
}
module_exit(mock_w1_exit);

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("1-Wire master with two DS18B20");
