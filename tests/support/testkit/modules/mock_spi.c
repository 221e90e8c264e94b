// SPDX-License-Identifier: GPL-2.0-or-later
/*
 * An SPI controller with /dev/spidev0.0 and /dev/spidev0.1: a loop of MOSI to
 * MISO, unless replies are set.
 *
 * In /sys/devices/platform/mock-spi:
 *   sent      one line per transfer: "csN MODE HZ BYTE...", in hexadecimal bytes
 *   replies   hexadecimal digits that the next transfers read before the loop
 *   clock     one line for each time the idle clock moved: "NANOSECONDS LEVEL",
 *             which it does as spi-bcm2835's, when a message begins
 *   half_duplex   1 for a controller with one data line
 *   fail, delay_ms, delay_us   see mock_bus.h
 */
#include <linux/module.h>
#include <linux/platform_device.h>
#include <linux/spi/spi.h>

#include "mock_bus.h"

#define CHIP_SELECTS 2
#define RECORDED_BYTES_MAX 256

struct mock_spi {
	struct mock_bus bus;
	struct spi_controller *controller;
	u8 replies[PAGE_SIZE / 2];
	size_t reply_count, reply_next;
	bool clock;
	char clocked[PAGE_SIZE / 4];
	size_t clocked_len;
};

static struct platform_device *mock_spi_device;

static int mock_spi_prepare_message(struct spi_controller *controller,
				    struct spi_message *message)
{
	struct mock_spi *mock = spi_controller_get_devdata(controller);
	bool idle = message->spi->mode & SPI_CPOL;

	mutex_lock(&mock->bus.lock);
	if (mock->clock != idle)
		mock->clocked_len += scnprintf(mock->clocked + mock->clocked_len,
					       sizeof(mock->clocked) - mock->clocked_len,
					       "%llu %d\n", ktime_get_ns(), idle);
	mock->clock = idle;
	mutex_unlock(&mock->bus.lock);
	return 0;
}

static int mock_spi_transfer_one(struct spi_controller *controller,
				 struct spi_device *spi,
				 struct spi_transfer *transfer)
{
	struct mock_spi *mock = spi_controller_get_devdata(controller);
	const u8 *tx = transfer->tx_buf;
	u8 *rx = transfer->rx_buf;
	unsigned int i;
	char what[40];
	int err;

	err = mock_bus_trouble(&mock->bus);
	if (err)
		return err;
	mutex_lock(&mock->bus.lock);
	scnprintf(what, sizeof(what), "cs%d %lu %u", spi->chip_select,
		  (unsigned long)(spi->mode & 3), transfer->speed_hz);
	mock_bus_record(&mock->bus, what, tx,
			tx ? min_t(size_t, transfer->len, RECORDED_BYTES_MAX) : 0);
	for (i = 0; rx && i < transfer->len; i++) {
		if (mock->reply_next < mock->reply_count)
			rx[i] = mock->replies[mock->reply_next++];
		else
			rx[i] = tx ? tx[i] : 0xff;
	}
	mutex_unlock(&mock->bus.lock);
	return 0;
}

static ssize_t replies_store(struct device *dev, struct device_attribute *attr,
			     const char *buf, size_t len)
{
	struct mock_spi *mock = dev_get_drvdata(dev);
	size_t count = min(len / 2, sizeof(mock->replies));
	int err;

	mutex_lock(&mock->bus.lock);
	err = hex2bin(mock->replies, buf, count);
	mock->reply_next = 0;
	mock->reply_count = err ? 0 : count;
	mutex_unlock(&mock->bus.lock);
	return err ? err : len;
}
static DEVICE_ATTR_WO(replies);

static ssize_t clock_show(struct device *dev, struct device_attribute *attr,
			  char *buf)
{
	struct mock_spi *mock = dev_get_drvdata(dev);
	ssize_t len;

	mutex_lock(&mock->bus.lock);
	len = mock->clocked_len;
	memcpy(buf, mock->clocked, len);
	mutex_unlock(&mock->bus.lock);
	return len;
}

/* Any write clears the record. */
static ssize_t clock_store(struct device *dev, struct device_attribute *attr,
			   const char *buf, size_t len)
{
	struct mock_spi *mock = dev_get_drvdata(dev);

	mutex_lock(&mock->bus.lock);
	mock->clocked_len = 0;
	mutex_unlock(&mock->bus.lock);
	return len;
}
static DEVICE_ATTR_RW(clock);

static ssize_t half_duplex_store(struct device *dev, struct device_attribute *attr,
				 const char *buf, size_t len)
{
	struct mock_spi *mock = dev_get_drvdata(dev);
	bool half_duplex;
	int err = kstrtobool(buf, &half_duplex);

	if (err)
		return err;
	if (half_duplex)
		mock->controller->flags |= SPI_CONTROLLER_HALF_DUPLEX;
	else
		mock->controller->flags &= ~SPI_CONTROLLER_HALF_DUPLEX;
	return len;
}
static DEVICE_ATTR_WO(half_duplex);

static struct attribute *mock_spi_attrs[] = {
	MOCK_BUS_ATTRS, &dev_attr_replies.attr, &dev_attr_clock.attr,
	&dev_attr_half_duplex.attr, NULL
};
ATTRIBUTE_GROUPS(mock_spi);

static int mock_spi_probe(struct platform_device *pdev)
{
	struct spi_controller *controller;
	struct mock_spi *mock;
	int err, i;

	controller = devm_spi_alloc_master(&pdev->dev, sizeof(*mock));
	if (!controller)
		return -ENOMEM;
	mock = spi_controller_get_devdata(controller);
	mock->controller = controller;
	mutex_init(&mock->bus.lock);
	platform_set_drvdata(pdev, mock);

	controller->bus_num = 0;
	controller->num_chipselect = CHIP_SELECTS;
	controller->mode_bits = SPI_CPOL | SPI_CPHA | SPI_CS_HIGH | SPI_LSB_FIRST |
				SPI_3WIRE | SPI_LOOP | SPI_NO_CS;
	controller->prepare_message = mock_spi_prepare_message;
	controller->transfer_one = mock_spi_transfer_one;
	err = devm_spi_register_controller(&pdev->dev, controller);
	if (err)
		return err;
	for (i = 0; i < CHIP_SELECTS; i++) {
		/* A name that spidev takes: it refuses a plain "spidev". */
		struct spi_board_info info = {
			.modalias = "dh2228fv",
			.max_speed_hz = 50000000,
			.chip_select = i,
		};

		if (!spi_new_device(controller, &info))
			return -ENODEV;
	}
	return 0;
}

static struct platform_driver mock_spi_driver = {
	.probe = mock_spi_probe,
	.driver = { .name = "mock-spi", .dev_groups = mock_spi_groups },
};

static int __init mock_spi_init(void)
{
	int err = platform_driver_register(&mock_spi_driver);

	if (err)
		return err;
	mock_spi_device = platform_device_register_simple("mock-spi", -1, NULL, 0);
	if (!IS_ERR(mock_spi_device))
		return 0;
	platform_driver_unregister(&mock_spi_driver);
	return PTR_ERR(mock_spi_device);
}
module_init(mock_spi_init);

static void __exit mock_spi_exit(void)
{
	platform_device_unregister(mock_spi_device);
	platform_driver_unregister(&mock_spi_driver);
}
module_exit(mock_spi_exit);

MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("SPI controller that loops, or replies by script");
