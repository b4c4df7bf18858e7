/* A libmodbus server and client for the tests, which compile it.
 *
 *   peer serve tcp | serve rtu TTY        holds registers: k reads 3 k; register 0 counts requests
 *   peer read tcp PORT | read rtu TTY     SLAVE FUNCTION ADDRESS COUNT: prints the registers
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

static int fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    return 1;
}

static int serve(modbus_t *ctx, int tcp)
{
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 200, 200);
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int listening = -1, n;

    for (int k = 0; k < 200; k++)
        map->tab_registers[k] = map->tab_input_registers[k] = 3 * k;
    if (tcp) {
        struct sockaddr_in at;
        socklen_t size = sizeof at;
        if ((listening = modbus_tcp_listen(ctx, 1)) < 0)
            return fail("listen");
        getsockname(listening, (struct sockaddr *)&at, &size);
        printf("%d\n", ntohs(at.sin_port));
    } else {
        modbus_set_slave(ctx, 5);
        if (modbus_connect(ctx) < 0)
            return fail("connect");
        printf("ready\n");
    }
    fflush(stdout);
    for (;;) {
        if (tcp && modbus_tcp_accept(ctx, &listening) < 0)
            return fail("accept");
        while ((n = modbus_receive(ctx, query)) >= 0) {
            if (n == 0)
                continue;
            map->tab_registers[0]++;
            map->tab_input_registers[0]++;
            modbus_reply(ctx, query, n, map);
        }
        if (!tcp)
            return 0;
    }
}

static int read_registers(modbus_t *ctx, char **argv)
{
    uint16_t found[125];
    int function = atoi(argv[1]), address = atoi(argv[2]), count = atoi(argv[3]);

    modbus_set_slave(ctx, atoi(argv[0]));
    if (modbus_connect(ctx) < 0)
        return fail("connect");
    int n = function == 3 ? modbus_read_registers(ctx, address, count, found)
                          : modbus_read_input_registers(ctx, address, count, found);
    if (n != count)
        return fail("read");
    for (int k = 0; k < n; k++)
        printf("%d ", found[k]);
    modbus_close(ctx);
    return 0;
}

int main(int argc, char **argv)
{
    int tcp = argc > 2 && strcmp(argv[2], "tcp") == 0, reads = strcmp(argv[1], "read") == 0;
    modbus_t *ctx = tcp ? modbus_new_tcp("127.0.0.1", reads ? atoi(argv[3]) : 0)
                        : modbus_new_rtu(argv[3], 9600, 'N', 8, 1);

    if (ctx == NULL)
        return fail("new");
    return reads ? read_registers(ctx, argv + 4) : serve(ctx, tcp);
}
