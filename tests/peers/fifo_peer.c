/* A vibration unit with a block FIFO, served by libmodbus, for the tests, which compile it.
 *
 *   peer TTY size|left     register 1: sampling rate; input register 2: FIFO, sample n is n, 2n, 3n
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define CHANNELS 3

static double now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return at.tv_sec + 1e-9 * at.tv_nsec;
}

int main(int argc, char **argv)
{
    modbus_t *ctx = modbus_new_rtu(argv[1], 115200, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 16, 160);
    int left = argc > 2 && strcmp(argv[2], "left") == 0, n;
    long made, read = 0; /* words */
    uint8_t query[MODBUS_RTU_MAX_ADU_LENGTH];
    double began = now();

    modbus_set_slave(ctx, 1);
    if (modbus_connect(ctx) < 0) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    printf("ready\n");
    fflush(stdout);
    while ((n = modbus_receive(ctx, query)) >= 0) {
        int function = query[1], address = query[2] << 8 | query[3];
        int words = (query[4] << 8 | query[5]) - 1;
        if (n == 0)
            continue;
        if (function == 4 && address == 2 && words >= 0 && words < 150) {
            made = CHANNELS * (long)((now() - began) * map->tab_registers[1]);
            map->tab_input_registers[2] = made - read;
            for (int k = 0; k < words; k++, read++)
                map->tab_input_registers[3 + k] = read / CHANNELS * (1 + read % CHANNELS);
            if (left)
                map->tab_input_registers[2] = made - read;
        }
        modbus_reply(ctx, query, n, map);
        if (function == 6) { /* the rate is set: sampling begins anew */
            began = now();
            read = 0;
        }
    }
    return 0;
}
