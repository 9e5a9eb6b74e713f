/* Reference of the board's state machine (docs/protocol.md), C99, no heap, no operating system.
 *
 * Call board_step() every millisecond and once for every frame that arrived; send what it leaves
 * in board.out. All hardware is behind struct board_hal. Tendons, servos, layers and positions
 * count from 0 in here and from 1 on the bus.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "tdma_values.h"

#define BOARD_OUT 128u        /* frames that one step can leave; more are dropped and counted */
#define BOARD_TICK_MS 10u     /* the fastest stream, WHEEL_FB */
#define BOARD_SLOT_MS 15u     /* servos get a new goal this often while they move */

struct board_frame {
    uint16_t id;
    uint8_t length;
    uint8_t data[8];
};

/* One robot's constants; `muxjax firmware` writes board_config.c. */
struct board_config {
    uint16_t words[4]; /* hash of the robot */
    uint8_t layers;
    uint8_t servos;    /* also tendons of a layer */
    uint8_t positions; /* of the axial motor */
    const uint8_t *facing; /* tendon that a servo meets, [position][servo] */
    const double *low_m; /* range of each tendon, margin for rounding included */
    const double *high_m;
    double turns_slack_m; /* so far beyond it TURNS is believed: clutches slip */
    double metres_per_servo_bit; /* 0.1 degree of servo to tendon displacement */
    double metres_per_count;     /* wheel encoder to tendon displacement */
    double servo_bits_per_s;     /* full speed */
    uint8_t coil_current;        /* of one coil, in CLUTCH_FB's unit */
    uint16_t probe_bits;         /* servo way of a probe, 0.1 degree */
    double probe_counts;         /* what a coupled wheel does then */
    uint16_t clutch_in_ms;
    uint16_t clutch_out_ms;
    uint16_t brake_ms;
    uint16_t horizon_ms;         /* no servo goal lies further ahead, should this code hang */
    uint16_t lowest_voltage;     /* 0.01 V; below it an armed board stops */
    uint8_t hottest_coil;        /* CLUTCH_FB's raw value; above it likewise */
    double window_counts;        /* wheel way over which it is compared with its servo's */
    double follow;               /* a wheel that goes less of its way stands still */
    uint8_t compare_every;       /* looks at which wheels are compared with their servos */
    uint8_t patience;            /* looks in a row at which a servo is silent or strained */
    uint8_t bad_samples;         /* of an encoder in a row that are a fault */
};

extern const struct board_config board_config;

enum board_servo_status {
    BOARD_SERVO_STALLED = 4, /* bits of SERVO_FB's Status that only the servo knows */
    BOARD_SERVO_OFFLINE = 8,
};

enum board_wheel_status {
    BOARD_WHEEL_PARITY = 1,
    BOARD_WHEEL_MAGNET = 2,
};

/* The hardware. Every function returns at once. */
struct board_hal {
    void *context; /* handed to every function */

    /* Multi-turn shaft angle, 0.1 degree, and the bits of enum board_servo_status. */
    int32_t (*servo_position)(void *context, uint8_t servo);
    uint8_t (*servo_status)(void *context, uint8_t servo);
    /* Turn the servos of a mask together, at constant speed, to absolute angles goals[servo] within
     * a time, and stand there if nothing follows. */
    void (*servo_goals)(void *context, uint16_t mask, const int32_t *goals, uint16_t within_ms);
    /* Bring every servo to a stand within brake_ms; hold no torque after it. */
    void (*servo_stop)(void *context);

    void (*axial_turn)(void *context, uint8_t position);
    void (*axial_stop)(void *context);
    bool (*axial_moving)(void *context);
    uint16_t (*axial_angle)(void *context); /* 0.01 degree */

    void (*clutch_coil)(void *context, uint8_t tendon, bool on);
    uint8_t (*clutch_temperature)(void *context); /* of the hottest coil, CLUTCH_FB's raw value */

    uint16_t (*wheel_angle)(void *context, uint8_t tendon); /* 14 bits, within the turn */
    uint8_t (*wheel_status)(void *context, uint8_t tendon); /* bits of enum board_wheel_status */

    uint16_t (*voltage)(void *context); /* 0.01 V */
    uint8_t (*tx_errors)(void *context); /* of the CAN controller */
    uint8_t (*rx_errors)(void *context);
};

enum board_job {
    BOARD_IDLE,
    BOARD_AXIAL,
    BOARD_COILS,     /* clutch plugs on their way in or out, the probe comes after */
    BOARD_PROBE_OUT,
    BOARD_PROBE_BACK,
    BOARD_MOVE,
    BOARD_BRAKE,     /* coming to rest: servos and axial motor ... */
    BOARD_DROP,      /* ... then the clutches */
};

struct board_answer {
    uint16_t seq;
    uint8_t status;
    uint8_t reason;
};

struct board {
    const struct board_config *config;
    const struct board_hal *hal;

    struct board_frame out[BOARD_OUT]; /* of the last step */
    uint8_t out_count;
    uint32_t out_dropped;

    uint32_t now; /* ms, wraps */
    uint8_t state, faults, boot_count;
    uint32_t refused[6]; /* by enum tdma_refusal */

    uint16_t session, last_seq;
    uint8_t words_matched; /* bit per word */
    bool host_heard;
    uint32_t host_at;
    uint8_t watchdog_ms;
    struct board_answer answers[TDMA_REMEMBERED];
    uint8_t answer_count, answer_next;
    uint8_t heard[2], sent[17]; /* alive counters; 0xFF: none yet */

    int16_t position; /* of the axial motor; -1 between two */
    bool axial_turning;
    bool energised[TDMA_MAX_TENDONS]; /* coil has current */
    bool verified[TDMA_MAX_TENDONS];  /* both encoders saw the clutch coupled */
    bool suspect[TDMA_MAX_TENDONS];   /* taken off in a hurry, nobody saw it come out */
    uint16_t staged; /* mask */
    int32_t staged_goal[TDMA_MAX_SERVOS];

    int32_t counts[TDMA_MAX_TENDONS]; /* wheels, whole turns included */
    bool turns_unknown[TDMA_MAX_TENDONS];
    bool turns_open[TDMA_MAX_TENDONS]; /* a host may say them, until somebody arms */
    uint8_t wheel_bits[TDMA_MAX_TENDONS]; /* enum board_wheel_status of the latest sample */
    uint8_t wheel_bad[TDMA_MAX_TENDONS];  /* bad samples in a row */
    uint8_t servo_silent[TDMA_MAX_SERVOS], servo_strained[TDMA_MAX_SERVOS]; /* looks in a row */

    uint8_t divider;
    bool streaming;
    uint32_t tick, tick_due;

    enum board_job job;
    bool job_ordered; /* by a command, which gets an answer */
    uint16_t job_seq;
    uint8_t job_op;
    uint32_t job_due;
    uint16_t job_mask; /* servos */
    uint8_t job_position;
    int32_t probe_from[TDMA_MAX_SERVOS]; /* wheel counts before the probe, by servo */
    uint16_t probe_followed;

    bool moving; /* servos are on a line from move_from to move_to */
    int32_t move_from[TDMA_MAX_SERVOS], move_to[TDMA_MAX_SERVOS];
    uint32_t move_begin, move_ms, move_fed;
    uint32_t looks;
    bool comparing; /* wheels with their servos, from these marks on */
    int32_t mark_servo[TDMA_MAX_SERVOS], mark_wheel[TDMA_MAX_SERVOS];
};

/* Power-up: silent and unarmed.
 *
 * turns: whole turns of every wheel as kept through the power-down; NULL where they were lost,
 * then the board arms only after Op TURNS told them. */
void board_init(struct board *board, const struct board_config *config,
                const struct board_hal *hal, uint32_t now_ms, uint8_t boot_count,
                const int8_t *turns);

/* Let time pass until now_ms, then take a frame (NULL: none). */
void board_step(struct board *board, uint32_t now_ms, const struct board_frame *frame);

#endif
