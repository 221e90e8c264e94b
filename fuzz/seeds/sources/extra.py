# As klippy looks messages up.
class Chip:
    def _build_config(self):
        """Looks up "commands" 'of' the MCU"""
        self.mcu.add_config_cmd("config_chip oid=%d spi_oid=%d"
                                % (self.oid, self.spi.get_oid()))
        self.query_cmd = self.mcu.lookup_command(
            "query_chip oid=%c"  # the first part
            ' rest_ticks=%u', cq=None)
        self.mcu.register_response(self._handle, r'chip_state oid=%c data=%*s', \
                                   self.oid)
