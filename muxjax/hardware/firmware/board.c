#include "board.h"

#include <math.h>
#include <string.h>

#include "e2e.h"
#include "tdma.h"

/* Index of a message's alive counter in board.sent. */
enum sent { SENT_EMCY, SENT_BEAT, SENT_ACK, SENT_AXIAL, SENT_CLUTCH, SENT_POWER, SENT_TURNS,
            SENT_SERVO /* 3 */, SENT_WHEEL = SENT_SERVO + 3 /* 3 */ };

struct refused {
    uint8_t reason; /* TDMA_REASON_NONE: go ahead */
    uint16_t detail;
};

static const struct refused FINE = {TDMA_REASON_NONE, 0};

static struct refused refuse(uint8_t reason, uint16_t detail)
{
    struct refused answer = {reason, detail};
    return answer;
}

static bool reached(uint32_t now, uint32_t due)
{
    return (int32_t)(now - due) >= 0;
}

static uint8_t tendons(const struct board *b)
{
    return (uint8_t)(b->config->layers * b->config->servos);
}

/* What the controller knows */

static uint8_t facing(const struct board *b, uint8_t servo)
{
    return b->config->facing[b->position * b->config->servos + servo];
}

static int layer(const struct board *b)
{
    return b->position < 0 ? -1 : facing(b, 0) / b->config->servos;
}

/* Tendon that a servo is verified to drive; -1 for none. */
static int driven(const struct board *b, uint8_t servo)
{
    if (b->position < 0) {
        return -1;
    }
    uint8_t tendon = facing(b, servo);
    return b->verified[tendon] && b->energised[tendon] ? tendon : -1;
}

/* Servos that face the clutches of a mask of the present layer. */
static uint16_t servos_facing(const struct board *b, uint32_t clutches)
{
    uint16_t mask = 0;
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (clutches >> (facing(b, s) % b->config->servos) & 1u) {
            mask |= (uint16_t)(1u << s);
        }
    }
    return mask;
}

static uint16_t clutch_mask(const struct board *b, const bool *set)
{
    uint16_t mask = 0;
    for (uint8_t c = 0; c < tendons(b); c++) {
        if (set[c]) {
            mask |= (uint16_t)(1u << (c % b->config->servos));
        }
    }
    return mask;
}

/* Clutches that are, or may be, in. */
static uint16_t held(const struct board *b)
{
    uint16_t count = 0;
    for (uint8_t c = 0; c < tendons(b); c++) {
        if (b->energised[c] || b->verified[c]) {
            count++;
        }
    }
    return count;
}

/* A reading with a bad status is not used, the last good one stands. */
static void read_wheels(struct board *b)
{
    const int32_t half = TDMA_COUNTS_PER_TURN / 2;
    for (uint8_t c = 0; c < tendons(b); c++) {
        b->wheel_bits[c] = b->hal->wheel_status(b->hal->context, c);
        if (b->wheel_bits[c]) {
            continue;
        }
        int32_t angle = b->hal->wheel_angle(b->hal->context, c);
        int32_t moved = (angle - b->counts[c]) & (TDMA_COUNTS_PER_TURN - 1);
        b->counts[c] += moved >= half ? moved - TDMA_COUNTS_PER_TURN : moved;
    }
}

/* Sending */

static void send(struct board *b, uint16_t id, enum sent counter, const uint8_t data[8])
{
    if (b->out_count == BOARD_OUT) {
        b->out_dropped++;
        return;
    }
    struct board_frame *frame = &b->out[b->out_count++];
    frame->id = id;
    frame->length = 8;
    memcpy(frame->data, data, 8);
    b->sent[counter] = (uint8_t)((b->sent[counter] + 1u) & 0x0Fu); /* 0xFF + 1: begins at 0 */
    e2e_protect(id, frame->data, b->sent[counter]);
}

static void acknowledge(struct board *b, uint16_t seq, uint8_t op, uint8_t status, uint8_t reason,
                        uint16_t detail)
{
    uint8_t data[8];
    struct tdma_ack_t ack = {
        .status = status, .seq = seq, .op = op, .reason = reason, .detail = detail};
    tdma_ack_pack(data, &ack, sizeof data);
    send(b, TDMA_ACK_FRAME_ID, SENT_ACK, data);
}

static void send_heartbeat(struct board *b)
{
    uint8_t data[8];
    struct tdma_board_hb_t beat = {.state = b->state, .boot_count = b->boot_count,
                                   .last_seq = b->last_seq, .faults = b->faults,
                                   .time = (uint16_t)b->now};
    tdma_board_hb_pack(data, &beat, sizeof data);
    send(b, TDMA_BOARD_HB_FRAME_ID, SENT_BEAT, data);
}

static void send_emergency(struct board *b, uint8_t reason, uint8_t op, uint8_t index)
{
    uint8_t data[8];
    struct tdma_emcy_t emergency = {.severity = 2, .code = reason, .subsystem = op,
                                    .index = index, .detail = (uint16_t)b->now};
    tdma_emcy_pack(data, &emergency, sizeof data);
    send(b, TDMA_EMCY_FRAME_ID, SENT_EMCY, data);
}

static void send_axial_and_clutches(struct board *b)
{
    uint8_t data[8];
    struct tdma_axial_fb_t axial = {.in_position = b->position >= 0, .moving = b->axial_turning,
                                    .position = b->hal->axial_angle(b->hal->context),
                                    .slot = (uint8_t)(b->position + 1)};
    tdma_axial_fb_pack(data, &axial, sizeof data);
    send(b, TDMA_AXIAL_FB_FRAME_ID, SENT_AXIAL, data);
    uint32_t coils = 0;
    for (uint8_t c = 0; c < tendons(b); c++) {
        coils += b->energised[c] ? b->config->coil_current : 0u;
    }
    struct tdma_clutch_fb_t clutches = {
        .layer = (uint8_t)(layer(b) + 1), .energised = clutch_mask(b, b->energised),
        .verified = clutch_mask(b, b->verified), .current = (uint8_t)(coils > 255u ? 255u : coils),
        .temperature = b->hal->clutch_temperature(b->hal->context)};
    tdma_clutch_fb_pack(data, &clutches, sizeof data);
    send(b, TDMA_CLUTCH_FB_FRAME_ID, SENT_CLUTCH, data);
}

/* SERVO_FB_1 to _3 have one layout, and so have WHEEL_FB_1 to _3. */
static void send_servos(struct board *b)
{
    uint8_t data[8];
    for (uint8_t s = 0; s < b->config->servos; s++) {
        uint8_t status = b->moving || (b->job == BOARD_BRAKE && !b->axial_turning);
        status |= (uint8_t)((driven(b, s) >= 0) << 1);
        status |= b->hal->servo_status(b->hal->context, s);
        struct tdma_servo_fb_1_t servo = {
            .group = (uint8_t)(s / 3), .position = b->hal->servo_position(b->hal->context, s),
            .status = status};
        tdma_servo_fb_1_pack(data, &servo, sizeof data);
        send(b, (uint16_t)(TDMA_SERVO_FB_1_FRAME_ID + s % 3), (enum sent)(SENT_SERVO + s % 3),
             data);
    }
}

static uint16_t wheel_word(const struct board *b, uint8_t tendon)
{
    return tendon < tendons(b) ? (uint16_t)(b->counts[tendon] & (TDMA_COUNTS_PER_TURN - 1)) : 0u;
}

static uint8_t wheel_flags(const struct board *b, uint8_t tendon)
{
    return tendon < tendons(b) ? b->wheel_bits[tendon] : 0u;
}

static void send_wheels(struct board *b)
{
    uint8_t data[8];
    for (uint8_t c = 0; c < tendons(b); c = (uint8_t)(c + 3)) {
        uint8_t trio = c / 3;
        struct tdma_wheel_fb_1_t wheels = {
            .group = trio / 3,
            .angle1 = wheel_word(b, c),
            .status1 = wheel_flags(b, c),
            .angle2 = wheel_word(b, (uint8_t)(c + 1)),
            .status2 = wheel_flags(b, (uint8_t)(c + 1)),
            .angle3 = wheel_word(b, (uint8_t)(c + 2)),
            .status3 = wheel_flags(b, (uint8_t)(c + 2))};
        tdma_wheel_fb_1_pack(data, &wheels, sizeof data);
        send(b, (uint16_t)(TDMA_WHEEL_FB_1_FRAME_ID + trio % 3), (enum sent)(SENT_WHEEL + trio % 3),
             data);
    }
}

static int8_t whole_turns(const struct board *b, uint8_t tendon)
{
    if (tendon >= tendons(b)) {
        return 0;
    }
    /* floor, for negative counts too */
    int32_t within = b->counts[tendon] & (TDMA_COUNTS_PER_TURN - 1);
    return (int8_t)((b->counts[tendon] - within) / TDMA_COUNTS_PER_TURN);
}

static void send_turns(struct board *b)
{
    uint8_t data[8];
    for (uint8_t c = 0; c < tendons(b); c = (uint8_t)(c + 6)) {
        struct tdma_wheel_turns_t turns = {.group = c / 6,
                                           .turns1 = whole_turns(b, c),
                                           .turns2 = whole_turns(b, (uint8_t)(c + 1)),
                                           .turns3 = whole_turns(b, (uint8_t)(c + 2)),
                                           .turns4 = whole_turns(b, (uint8_t)(c + 3)),
                                           .turns5 = whole_turns(b, (uint8_t)(c + 4)),
                                           .turns6 = whole_turns(b, (uint8_t)(c + 5))};
        tdma_wheel_turns_pack(data, &turns, sizeof data);
        send(b, TDMA_WHEEL_TURNS_FRAME_ID, SENT_TURNS, data);
    }
}

static void send_power(struct board *b)
{
    uint8_t data[8];
    uint32_t refused = 0;
    for (size_t k = 0; k < sizeof b->refused / sizeof b->refused[0]; k++) {
        refused += b->refused[k];
    }
    struct tdma_power_fb_t power = {.voltage = b->hal->voltage(b->hal->context),
                                    .tx_errors = b->hal->tx_errors(b->hal->context),
                                    .rx_errors = b->hal->rx_errors(b->hal->context),
                                    .refused = (uint16_t)(refused > 0xFFFFu ? 0xFFFFu : refused)};
    tdma_power_fb_pack(data, &power, sizeof data);
    send(b, TDMA_POWER_FB_FRAME_ID, SENT_POWER, data);
}

/* All but the heartbeat come at 1 / divider of their rate. */
static void send_streams(struct board *b)
{
    if (b->tick % (TDMA_BOARD_BEAT_MS / BOARD_TICK_MS) == 0) {
        send_heartbeat(b);
    }
    if (b->tick % b->divider == 0) {
        uint32_t nth = b->tick / b->divider;
        send_wheels(b);
        if (nth % 2 == 0) {
            send_axial_and_clutches(b);
        }
        if (nth % 4 == 0) {
            send_servos(b);
        }
        if (nth % 10 == 0) {
            send_power(b);
        }
        if (nth % 20 == 0) {
            send_turns(b); /* with the wheels: sampled at one instant */
        }
    }
}

static void begin_streams(struct board *b, uint8_t divider)
{
    b->divider = divider;
    b->tick = 0;
    b->tick_due = b->now;
    b->streaming = true;
}

/* Answers, kept for duplicates */

static struct board_answer *remembered(struct board *b, uint16_t seq)
{
    for (uint8_t k = 0; k < b->answer_count; k++) {
        if (b->answers[k].seq == seq) {
            return &b->answers[k];
        }
    }
    return NULL;
}

static void answer(struct board *b, uint16_t seq, uint8_t op, uint8_t status, uint8_t reason,
                   uint16_t detail)
{
    struct board_answer *kept = remembered(b, seq);
    if (kept == NULL) {
        kept = &b->answers[b->answer_next];
        b->answer_next = (uint8_t)((b->answer_next + 1u) % TDMA_REMEMBERED);
        if (b->answer_count < TDMA_REMEMBERED) {
            b->answer_count++;
        }
    }
    kept->seq = seq;
    kept->status = status;
    kept->reason = reason;
    acknowledge(b, seq, op, status, reason, detail);
}

/* Motion of the servos: a line of goals, each a short way ahead */

static void feed_servos(struct board *b)
{
    uint32_t since = b->now - b->move_begin;
    uint32_t ahead = since + b->config->horizon_ms;
    int32_t goals[TDMA_MAX_SERVOS] = {0};
    if (ahead > b->move_ms) {
        ahead = b->move_ms;
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        int64_t way = b->move_to[s] - b->move_from[s];
        goals[s] = b->move_from[s] + (int32_t)(way * (int64_t)ahead / (int64_t)b->move_ms);
    }
    b->hal->servo_goals(b->hal->context, b->job_mask, goals, (uint16_t)(ahead - since));
    b->move_fed = b->now;
}

/* Turn the job's servos to move_to[]; they end together. Returns the duration. */
static uint32_t begin_move(struct board *b)
{
    int32_t longest = 0;
    for (uint8_t s = 0; s < b->config->servos; s++) {
        b->move_from[s] = b->hal->servo_position(b->hal->context, s);
        if (!(b->job_mask >> s & 1u)) {
            b->move_to[s] = b->move_from[s];
        }
        int32_t way = b->move_to[s] - b->move_from[s];
        way = way < 0 ? -way : way;
        longest = way > longest ? way : longest;
    }
    b->move_ms = (uint32_t)ceil(1e3 * longest / b->config->servo_bits_per_s);
    b->move_begin = b->now;
    b->moving = b->move_ms > 0;
    if (b->moving) {
        feed_servos(b);
    }
    return b->move_ms;
}

/* Jobs, one at a time */

static void end_job(struct board *b, uint8_t reason)
{
    b->job = BOARD_IDLE;
    b->moving = false;
    b->comparing = false;
    if (b->job_ordered) {
        uint8_t status = reason == TDMA_REASON_NONE ? TDMA_STATUS_DONE : TDMA_STATUS_ABORTED;
        answer(b, b->job_seq, b->job_op, status, reason, (uint16_t)b->now);
    }
    send_axial_and_clutches(b);
    send_servos(b);
    send_wheels(b);
}

static void wait(struct board *b, enum board_job job, uint32_t ms)
{
    b->job = job;
    b->job_due = b->now + ms;
}

static void drop_clutches(struct board *b)
{
    bool any = held(b) > 0;
    b->axial_turning = false;
    for (uint8_t c = 0; c < tendons(b); c++) {
        b->suspect[c] = b->suspect[c] || b->energised[c] || b->verified[c];
        b->energised[c] = false;
        b->hal->clutch_coil(b->hal->context, c, false);
    }
    wait(b, BOARD_DROP, any ? b->config->clutch_out_ms : 0u);
}

/* Brake, then take the clutches off. */
static void come_to_rest(struct board *b, bool was_moving, bool ordered)
{
    b->job_ordered = ordered;
    b->staged = 0;
    b->moving = false;
    b->hal->servo_stop(b->hal->context);
    b->hal->axial_stop(b->hal->context);
    if (was_moving) {
        wait(b, BOARD_BRAKE, b->config->brake_ms);
    } else {
        drop_clutches(b);
    }
}

static bool abort_job(struct board *b, uint8_t reason)
{
    bool was_moving = b->moving || b->axial_turning || b->job == BOARD_BRAKE;
    if (b->job != BOARD_IDLE) {
        end_job(b, reason);
    }
    return was_moving;
}

static void stop(struct board *b, uint8_t state, uint8_t reason, uint8_t index)
{
    uint8_t ran = b->job != BOARD_IDLE && b->job_ordered ? b->job_op : 0u;
    b->state = state;
    b->words_matched = 0;
    bool was_moving = abort_job(b, reason);
    send_emergency(b, reason, ran, index);
    come_to_rest(b, was_moving, false);
}

static uint8_t fault_of(uint8_t reason)
{
    switch (reason) {
    case TDMA_REASON_SERVO_STALLED:
    case TDMA_REASON_SERVO_OFFLINE:
        return TDMA_FAULT_SERVO;
    case TDMA_REASON_ENCODER_FAULT:
        return TDMA_FAULT_ENCODER;
    case TDMA_REASON_COIL_HOT:
        return TDMA_FAULT_COIL_HOT;
    case TDMA_REASON_UNDERVOLTAGE:
        return TDMA_FAULT_VOLTAGE;
    default: /* WHEEL_STILL: either may be at fault */
        return TDMA_FAULT_ENCODER | TDMA_FAULT_SERVO;
    }
}

/* A part failed: to the safe state. index: servo or tendon, from 1; 0 if none. */
static void trip(struct board *b, uint8_t reason, uint8_t index)
{
    b->faults |= fault_of(reason);
    stop(b, TDMA_STATE_SAFE, reason, index);
}

static void begin_probe(struct board *b)
{
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (b->job_mask >> s & 1u) {
            uint8_t c = facing(b, s);
            /* towards the middle of the range, so that no probe leaves it */
            double middle = (b->config->low_m[c] + b->config->high_m[c]) / 2;
            bool up = middle - b->counts[c] * b->config->metres_per_count > 0;
            b->probe_from[s] = b->counts[c];
            b->move_to[s] = b->hal->servo_position(b->hal->context, s) +
                            (up ? b->config->probe_bits : -(int32_t)b->config->probe_bits);
        }
    }
    wait(b, BOARD_PROBE_OUT, begin_move(b));
}

/* What a servo that must turn, and did not, says; TDMA_REASON_NONE if all turned. */
static uint8_t servo_stood(const struct board *b, uint8_t *servo)
{
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (b->job_mask >> s & 1u) {
            int32_t way = b->hal->servo_position(b->hal->context, s) - b->move_from[s];
            if ((way < 0 ? -way : way) < b->config->follow * b->config->probe_bits) {
                *servo = s;
                bool silent = b->hal->servo_status(b->hal->context, s) & BOARD_SERVO_OFFLINE;
                return silent ? TDMA_REASON_SERVO_OFFLINE : TDMA_REASON_SERVO_STALLED;
            }
        }
    }
    return TDMA_REASON_NONE;
}

static void turn_probe_back(struct board *b)
{
    uint8_t servo = 0;
    uint8_t reason = b->job_op == TDMA_OP_AXIAL ? TDMA_REASON_NONE : servo_stood(b, &servo);
    if (reason) {
        trip(b, reason, (uint8_t)(servo + 1));
        return;
    }
    b->probe_followed = 0;
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (b->job_mask >> s & 1u) {
            int32_t moved = b->counts[facing(b, s)] - b->probe_from[s];
            if ((moved < 0 ? -moved : moved) > b->config->follow * b->config->probe_counts) {
                b->probe_followed |= (uint16_t)(1u << s);
            }
        }
        b->move_to[s] = b->move_from[s];
    }
    wait(b, BOARD_PROBE_BACK, begin_move(b));
}

static void turn_axial(struct board *b)
{
    memset(b->suspect, 0, sizeof b->suspect);
    if (b->job_position == b->position) {
        end_job(b, TDMA_REASON_NONE);
        return;
    }
    b->axial_turning = true;
    b->position = -1;
    b->hal->axial_turn(b->hal->context, b->job_position);
    wait(b, BOARD_AXIAL, 1);
}

static void end_probe(struct board *b)
{
    bool engaged = b->job_op == TDMA_OP_ENGAGE;
    bool any = b->probe_followed != 0;
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (b->job_mask >> s & 1u) {
            if (b->probe_followed >> s & 1u) {
                b->verified[facing(b, s)] = b->verified[facing(b, s)] || b->job_op != TDMA_OP_RELEASE;
            } else if (!engaged) {
                b->verified[facing(b, s)] = false;
            }
        }
    }
    b->moving = false;
    if (engaged) {
        bool all = b->probe_followed == b->job_mask;
        end_job(b, all ? TDMA_REASON_NONE : TDMA_REASON_NOT_SEATED);
    } else if (any) {
        end_job(b, TDMA_REASON_NOT_RELEASED);
    } else if (b->job_op == TDMA_OP_AXIAL) {
        turn_axial(b);
    } else {
        end_job(b, TDMA_REASON_NONE);
    }
}

static void continue_job(struct board *b)
{
    switch (b->job) {
    case BOARD_AXIAL:
        if (b->hal->axial_moving(b->hal->context)) {
            wait(b, BOARD_AXIAL, 1);
            break;
        }
        b->axial_turning = false;
        b->position = b->job_position;
        end_job(b, TDMA_REASON_NONE);
        break;
    case BOARD_COILS:
        begin_probe(b);
        break;
    case BOARD_PROBE_OUT:
        turn_probe_back(b);
        break;
    case BOARD_PROBE_BACK:
        end_probe(b);
        break;
    case BOARD_MOVE:
        end_job(b, TDMA_REASON_NONE);
        break;
    case BOARD_BRAKE:
        drop_clutches(b);
        break;
    case BOARD_DROP:
        memset(b->verified, 0, sizeof b->verified);
        end_job(b, TDMA_REASON_NONE);
        break;
    case BOARD_IDLE:
        break;
    }
}

/* What is refused, and why: the checks of every opcode in the order of interlocks.py */

static struct refused beyond_range(const struct board *b, uint8_t servo, int32_t goal)
{
    int tendon = driven(b, servo);
    if (tendon < 0) {
        return refuse(TDMA_REASON_NOT_COUPLED, (uint16_t)(servo + 1));
    }
    int32_t way = goal - b->hal->servo_position(b->hal->context, servo);
    double end = b->counts[tendon] * b->config->metres_per_count +
                 way * b->config->metres_per_servo_bit;
    bool inside = b->config->low_m[tendon] <= end && end <= b->config->high_m[tendon];
    return inside ? FINE : refuse(TDMA_REASON_TENDON_RANGE, (uint16_t)(tendon + 1));
}

static bool host_alive(const struct board *b)
{
    return b->host_heard && !reached(b->now, b->host_at + b->watchdog_ms);
}

static struct refused check_hello(const struct board *b, int32_t arg)
{
    if (b->state == TDMA_STATE_ARMED) {
        return refuse(TDMA_REASON_ARMED_ALREADY, b->session);
    }
    if (arg >> 16 != TDMA_VERSION) {
        return refuse(TDMA_REASON_WRONG_VERSION, TDMA_VERSION);
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check_greeted(const struct board *b)
{
    return b->state == TDMA_STATE_READY ? FINE : refuse(TDMA_REASON_WRONG_SESSION, b->state);
}

static struct refused check_robot(const struct board *b, uint8_t idx, int32_t arg)
{
    struct refused greeted = check_greeted(b);
    if (greeted.reason) {
        return greeted;
    }
    bool known = 1 <= idx && idx <= 4;
    uint16_t own = known ? b->config->words[idx - 1] : 0u;
    return known && arg == own ? FINE : refuse(TDMA_REASON_WRONG_ROBOT, own);
}

/* Counts of the wheel of TURNS, were it in the turn that its arg says. */
static int32_t told_counts(const struct board *b, int32_t arg)
{
    int32_t within = b->counts[(arg >> 16) - 1] & (TDMA_COUNTS_PER_TURN - 1);
    return within + (int16_t)(arg & 0xFFFF) * (int32_t)TDMA_COUNTS_PER_TURN;
}

static struct refused check_turns(const struct board *b, int32_t arg)
{
    if (b->state == TDMA_STATE_ARMED) {
        return refuse(TDMA_REASON_ARMED_ALREADY, b->session);
    }
    struct refused greeted = check_greeted(b);
    if (greeted.reason) {
        return greeted;
    }
    int32_t wheel = (arg >> 16) - 1;
    if (!(0 <= wheel && wheel < tendons(b))) {
        return refuse(TDMA_REASON_TURNS_UNKNOWN, tendons(b));
    }
    int32_t told = told_counts(b, arg);
    if (!b->turns_open[wheel] && told != b->counts[wheel]) {
        return refuse(TDMA_REASON_TURNS_UNKNOWN, (uint16_t)(wheel + 1));
    }
    double length = told * b->config->metres_per_count;
    double slack = b->config->turns_slack_m;
    bool inside = b->config->low_m[wheel] - slack <= length
        && length <= b->config->high_m[wheel] + slack;
    return inside ? FINE : refuse(TDMA_REASON_TENDON_RANGE, (uint16_t)(wheel + 1));
}

static struct refused check_arm(const struct board *b, int32_t arg)
{
    if (b->state == TDMA_STATE_ARMED) {
        return refuse(TDMA_REASON_ARMED_ALREADY, b->session);
    }
    struct refused greeted = check_greeted(b);
    if (greeted.reason) {
        return greeted;
    }
    if (arg != b->session) {
        return refuse(TDMA_REASON_WRONG_SESSION, b->session);
    }
    uint16_t matched = 0;
    for (int k = 0; k < 4; k++) {
        matched += b->words_matched >> k & 1u;
    }
    if (matched != 4) {
        return refuse(TDMA_REASON_ROBOT_UNCHECKED, matched);
    }
    for (uint8_t c = 0; c < tendons(b); c++) {
        if (b->turns_unknown[c]) {
            return refuse(TDMA_REASON_TURNS_UNKNOWN, (uint16_t)(c + 1));
        }
    }
    uint16_t voltage = b->hal->voltage(b->hal->context);
    if (voltage < b->config->lowest_voltage) {
        return refuse(TDMA_REASON_UNDERVOLTAGE, voltage);
    }
    uint8_t coil = b->hal->clutch_temperature(b->hal->context);
    if (coil > b->config->hottest_coil) {
        return refuse(TDMA_REASON_COIL_HOT, (uint16_t)(coil - 40));
    }
    if (!host_alive(b)) {
        return refuse(TDMA_REASON_NO_HEARTBEAT, 0);
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check_axial(const struct board *b, int32_t arg)
{
    if (!(1 <= arg && arg <= b->config->positions)) {
        return refuse(TDMA_REASON_UNKNOWN_AXIAL, b->config->positions);
    }
    if (held(b)) {
        return refuse(TDMA_REASON_CLUTCH_IN, held(b));
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check_clutches(const struct board *b, uint8_t idx, int32_t arg)
{
    if (b->axial_turning) {
        return refuse(TDMA_REASON_AXIAL_MOVING, 0);
    }
    if (b->position < 0) {
        return refuse(TDMA_REASON_NOT_IN_SLOT, 0);
    }
    if (idx != layer(b) + 1) {
        return refuse(TDMA_REASON_WRONG_LAYER, (uint16_t)(layer(b) + 1));
    }
    if (!(0 < arg && arg < 1l << b->config->servos)) {
        return refuse(TDMA_REASON_UNKNOWN_CLUTCH, b->config->servos);
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check_stage(const struct board *b, uint8_t idx, int32_t arg)
{
    if (!(1 <= idx && idx <= b->config->servos)) {
        return refuse(TDMA_REASON_UNKNOWN_SERVO, b->config->servos);
    }
    uint8_t servo = (uint8_t)(idx - 1);
    if (driven(b, servo) < 0) {
        return refuse(TDMA_REASON_NOT_COUPLED, idx);
    }
    if (arg > TDMA_SERVO_LIMIT || arg < -TDMA_SERVO_LIMIT) {
        return refuse(TDMA_REASON_SERVO_RANGE, 0);
    }
    struct refused beyond = beyond_range(b, servo, arg);
    if (beyond.reason) {
        return beyond;
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check_start(const struct board *b, int32_t arg)
{
    if (!(0 < arg && arg < 1l << b->config->servos)) {
        return refuse(TDMA_REASON_UNKNOWN_SERVO, b->config->servos);
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if ((arg >> s & 1) && !(b->staged >> s & 1u)) {
            return refuse(TDMA_REASON_NOT_STAGED, (uint16_t)(s + 1));
        }
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if ((arg >> s & 1) && driven(b, s) < 0) {
            return refuse(TDMA_REASON_NOT_COUPLED, (uint16_t)(s + 1));
        }
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (arg >> s & 1) {
            struct refused beyond = beyond_range(b, s, b->staged_goal[s]);
            if (beyond.reason) {
                return beyond;
            }
        }
    }
    return b->job != BOARD_IDLE ? refuse(TDMA_REASON_BUSY, 0) : FINE;
}

static struct refused check(const struct board *b, uint8_t op, uint8_t idx, int32_t arg)
{
    if (op < TDMA_OP_HELLO || op > TDMA_OP_TURNS) {
        return refuse(TDMA_REASON_UNKNOWN_OP, 0);
    }
    if (op == TDMA_OP_SET_STREAM) {
        struct refused greeted = check_greeted(b);
        if (greeted.reason) {
            return greeted;
        }
        bool fits = 1 <= arg && arg <= TDMA_MAX_DIVIDER;
        return fits ? FINE : refuse(TDMA_REASON_STREAM_RANGE, TDMA_MAX_DIVIDER);
    }
    if (b->state == TDMA_STATE_ESTOPPED) {
        return refuse(TDMA_REASON_ESTOPPED, 0);
    }
    switch (op) {
    case TDMA_OP_HELLO:
        return check_hello(b, arg);
    case TDMA_OP_ROBOT:
        return check_robot(b, idx, arg);
    case TDMA_OP_TURNS:
        return check_turns(b, arg);
    case TDMA_OP_ARM:
        return check_arm(b, arg);
    default:
        break;
    }
    if (b->state != TDMA_STATE_ARMED) {
        return refuse(TDMA_REASON_NOT_ARMED, b->state);
    }
    switch (op) {
    case TDMA_OP_AXIAL:
        return check_axial(b, arg);
    case TDMA_OP_ENGAGE:
    case TDMA_OP_RELEASE:
        return check_clutches(b, idx, arg);
    case TDMA_OP_STAGE:
        return check_stage(b, idx, arg);
    case TDMA_OP_START:
        return check_start(b, arg);
    default: /* DISARM */
        return FINE;
    }
}

/* What the commands do */

static void hello(struct board *b, int32_t arg)
{
    b->state = TDMA_STATE_READY;
    b->session = (uint16_t)(arg & 0xFFFF);
    b->answer_count = b->answer_next = 0;
    b->words_matched = 0;
    b->host_heard = false;
    begin_streams(b, 1);
}

static void learn_turns(struct board *b, int32_t arg)
{
    uint8_t c = (uint8_t)((arg >> 16) - 1);
    b->counts[c] = told_counts(b, arg);
    b->turns_unknown[c] = false;
    bool any = false;
    for (uint8_t k = 0; k < tendons(b); k++) {
        any = any || b->turns_unknown[k];
    }
    if (!any) {
        b->faults &= (uint8_t)~TDMA_FAULT_TURNS_LOST;
    }
}

static void switch_coils(struct board *b, bool on)
{
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (b->job_mask >> s & 1u) {
            b->energised[facing(b, s)] = on;
            b->hal->clutch_coil(b->hal->context, facing(b, s), on);
        }
    }
    wait(b, BOARD_COILS, on ? b->config->clutch_in_ms : b->config->clutch_out_ms);
}

static bool any_suspect(const struct board *b)
{
    for (uint8_t c = 0; c < tendons(b); c++) {
        if (b->suspect[c]) {
            return true;
        }
    }
    return false;
}

/* Commands that take no time; false: begin_job has to follow. */
static bool obey_at_once(struct board *b, uint8_t op, uint8_t idx, int32_t arg)
{
    switch (op) {
    case TDMA_OP_HELLO:
        hello(b, arg);
        return true;
    case TDMA_OP_ROBOT:
        b->words_matched |= (uint8_t)(1u << (idx - 1));
        return true;
    case TDMA_OP_TURNS:
        learn_turns(b, arg);
        return true;
    case TDMA_OP_ARM:
        memset(b->turns_open, 0, sizeof b->turns_open);
        b->state = TDMA_STATE_ARMED;
        return true;
    case TDMA_OP_AXIAL:
        return arg - 1 == b->position && !any_suspect(b);
    case TDMA_OP_STAGE:
        b->staged |= (uint16_t)(1u << (idx - 1));
        b->staged_goal[idx - 1] = arg;
        return true;
    case TDMA_OP_SET_STREAM:
        begin_streams(b, (uint8_t)arg);
        return true;
    default:
        return false;
    }
}

static void begin_comparison(struct board *b)
{
    b->comparing = b->moving;
    for (uint8_t s = 0; s < b->config->servos; s++) {
        b->mark_servo[s] = b->move_from[s];
        b->mark_wheel[s] = b->counts[facing(b, s)];
    }
}

static void begin_job(struct board *b, uint8_t op, int32_t arg)
{
    switch (op) {
    case TDMA_OP_AXIAL:
        b->job_position = (uint8_t)(arg - 1);
        if (any_suspect(b) && b->position >= 0) { /* first see that every plug is out */
            b->job_mask = 0;
            for (uint8_t s = 0; s < b->config->servos; s++) {
                b->job_mask |= (uint16_t)(b->suspect[facing(b, s)] << s);
            }
            begin_probe(b);
        } else {
            turn_axial(b);
        }
        break;
    case TDMA_OP_ENGAGE:
    case TDMA_OP_RELEASE:
        b->job_mask = servos_facing(b, (uint32_t)arg);
        switch_coils(b, op == TDMA_OP_ENGAGE);
        break;
    default: /* START */
        b->job_mask = (uint16_t)arg;
        b->staged &= (uint16_t)~b->job_mask;
        memcpy(b->move_to, b->staged_goal, sizeof b->move_to);
        wait(b, BOARD_MOVE, begin_move(b));
        begin_comparison(b);
        break;
    }
}

static void disarm(struct board *b, uint16_t seq)
{
    b->state = TDMA_STATE_READY;
    b->words_matched = 0;
    if (b->job == BOARD_IDLE && held(b) == 0) {
        answer(b, seq, TDMA_OP_DISARM, TDMA_STATUS_DONE, TDMA_REASON_NONE, (uint16_t)b->now);
        return;
    }
    bool was_moving = abort_job(b, TDMA_REASON_DISARMED);
    answer(b, seq, TDMA_OP_DISARM, TDMA_STATUS_ACCEPTED, TDMA_REASON_NONE, (uint16_t)b->now);
    b->job_seq = seq;
    b->job_op = TDMA_OP_DISARM;
    come_to_rest(b, was_moving, true);
}

static void obey(struct board *b, uint16_t seq, uint8_t op, uint8_t idx, int32_t arg)
{
    b->last_seq = seq;
    if (op == TDMA_OP_DISARM) {
        disarm(b, seq);
    } else if (obey_at_once(b, op, idx, arg)) {
        answer(b, seq, op, TDMA_STATUS_DONE, TDMA_REASON_NONE, (uint16_t)b->now);
    } else {
        answer(b, seq, op, TDMA_STATUS_ACCEPTED, TDMA_REASON_NONE, (uint16_t)b->now);
        b->job_ordered = true;
        b->job_seq = seq;
        b->job_op = op;
        begin_job(b, op, arg);
    }
}

static void command(struct board *b, const struct tdma_cmd_t *cmd)
{
    bool is_hello = cmd->op == TDMA_OP_HELLO;
    bool new_session = is_hello && (uint16_t)(cmd->arg & 0xFFFF) != b->session;
    const struct board_answer *kept = remembered(b, cmd->seq);
    if (kept != NULL && !new_session) {
        acknowledge(b, cmd->seq, cmd->op, TDMA_STATUS_DUPLICATE, kept->reason, kept->status);
        return;
    }
    uint16_t ahead = (uint16_t)(cmd->seq - b->last_seq);
    if (!is_hello && !(1 <= ahead && ahead <= TDMA_SEQUENCE_WINDOW)) {
        acknowledge(b, cmd->seq, cmd->op, TDMA_STATUS_REJECTED, TDMA_REASON_SEQUENCE, b->last_seq);
        return;
    }
    struct refused refused = check(b, cmd->op, cmd->idx, cmd->arg);
    if (refused.reason == TDMA_REASON_NONE) {
        obey(b, cmd->seq, cmd->op, cmd->idx, cmd->arg);
    } else if (refused.reason == TDMA_REASON_BUSY || refused.reason == TDMA_REASON_NO_HEARTBEAT) {
        /* its number is not used up: it may be tried again */
        acknowledge(b, cmd->seq, cmd->op, TDMA_STATUS_BUSY, refused.reason, refused.detail);
    } else if (is_hello) { /* a stranger's HELLO must not shift the session's numbers */
        acknowledge(b, cmd->seq, cmd->op, TDMA_STATUS_REJECTED, refused.reason, refused.detail);
    } else {
        b->last_seq = cmd->seq;
        answer(b, cmd->seq, cmd->op, TDMA_STATUS_REJECTED, refused.reason, refused.detail);
    }
}

static void hear_host(struct board *b, const struct tdma_host_hb_t *beat)
{
    if (beat->session == b->session) {
        b->host_heard = true;
        b->host_at = b->now;
        b->watchdog_ms = beat->watchdog < TDMA_WATCHDOG_MS ? beat->watchdog : TDMA_WATCHDOG_MS;
    }
}

static void emergency_stop(struct board *b)
{
    if (b->state != TDMA_STATE_ESTOPPED) {
        b->faults |= TDMA_FAULT_ESTOP;
        stop(b, TDMA_STATE_ESTOPPED, TDMA_REASON_ESTOPPED, 0);
    }
    if (!b->streaming) {
        begin_streams(b, 1);
    }
    send_heartbeat(b);
}

/* Whether a frame is refused: 0, or its enum tdma_refusal. */
static uint8_t refusal(struct board *b, const struct board_frame *frame)
{
    bool is_beat = frame->id == TDMA_HOST_HB_FRAME_ID;
    if (!is_beat && frame->id != TDMA_CMD_FRAME_ID) {
        return TDMA_REFUSAL_UNKNOWN_ID;
    }
    if (frame->length != 8) {
        return TDMA_REFUSAL_LENGTH;
    }
    if (frame->data[0] != e2e_frame_crc(frame->id, frame->data)) {
        return TDMA_REFUSAL_CRC;
    }
    uint8_t counter = frame->data[1] & 0x0Fu;
    if (b->heard[is_beat] == counter) {
        return TDMA_REFUSAL_COUNTER;
    }
    b->heard[is_beat] = counter;
    return 0;
}

static void receive(struct board *b, const struct board_frame *frame)
{
    if (frame->id == TDMA_ESTOP_FRAME_ID) { /* whatever its CRC, counter and length */
        emergency_stop(b);
        return;
    }
    uint8_t refused = refusal(b, frame);
    if (refused) {
        b->refused[refused]++;
        b->faults |= TDMA_FAULT_FRAMES_REFUSED;
    } else if (frame->id == TDMA_CMD_FRAME_ID) {
        struct tdma_cmd_t cmd;
        tdma_cmd_unpack(&cmd, frame->data, sizeof frame->data);
        command(b, &cmd);
    } else {
        struct tdma_host_hb_t beat;
        tdma_host_hb_unpack(&beat, frame->data, sizeof frame->data);
        hear_host(b, &beat);
    }
}

void board_init(struct board *board, const struct board_config *config,
                const struct board_hal *hal, uint32_t now_ms, uint8_t boot_count,
                const int8_t *turns)
{
    memset(board, 0, sizeof *board);
    board->config = config;
    board->hal = hal;
    board->now = now_ms;
    board->boot_count = boot_count;
    board->state = TDMA_STATE_SILENT;
    board->watchdog_ms = TDMA_WATCHDOG_MS;
    board->divider = 1;
    board->position = -1; /* the drum's slot is not known until it has turned to one */
    memset(board->heard, 0xFF, sizeof board->heard);
    memset(board->sent, 0xFF, sizeof board->sent);
    if (turns == NULL) {
        board->faults |= TDMA_FAULT_TURNS_LOST;
    }
    for (uint8_t c = 0; c < tendons(board); c++) {
        board->counts[c] = hal->wheel_angle(hal->context, c);
        if (turns != NULL) {
            board->counts[c] += turns[c] * (int32_t)TDMA_COUNTS_PER_TURN;
        }
        board->turns_unknown[c] = board->turns_open[c] = turns == NULL;
        hal->clutch_coil(hal->context, c, false);
    }
}

/* What stops an armed board: faults of parts in use that its sensors show */

static bool lasts(uint8_t *looks, bool now, uint8_t patience)
{
    *looks = (uint8_t)(now ? *looks + 1u : 0u);
    return *looks >= patience;
}

/* Whether the wheel of a servo follows it; each window begins where the last one ended. */
static bool follows(struct board *b, uint8_t servo, uint8_t tendon)
{
    int32_t position = b->hal->servo_position(b->hal->context, servo);
    double way = (position - b->mark_servo[servo]) * b->config->metres_per_servo_bit /
                 b->config->metres_per_count;
    double gone = b->counts[tendon] - b->mark_wheel[servo];
    if (fabs(way) < b->config->window_counts) {
        return true;
    }
    if (copysign(1, way) * gone < b->config->follow * fabs(way)) {
        return false;
    }
    b->mark_servo[servo] = position;
    b->mark_wheel[servo] = b->counts[tendon];
    return true;
}

/* Looked at in every tick while armed. */
static void guard(struct board *b)
{
    if (b->hal->voltage(b->hal->context) < b->config->lowest_voltage) {
        trip(b, TDMA_REASON_UNDERVOLTAGE, 0);
        return;
    }
    if (b->hal->clutch_temperature(b->hal->context) > b->config->hottest_coil) {
        trip(b, TDMA_REASON_COIL_HOT, 0);
        return;
    }
    uint16_t silent = 0, strained = 0, failed = 0; /* servos */
    for (uint8_t s = 0; s < b->config->servos && b->position >= 0; s++) {
        uint8_t tendon = facing(b, s);
        bool used = b->energised[tendon];
        uint8_t status = b->hal->servo_status(b->hal->context, s);
        bool offline = status & BOARD_SERVO_OFFLINE;
        bool stalled = !offline && (status & BOARD_SERVO_STALLED);
        uint16_t bit = (uint16_t)(1u << s);
        silent |= lasts(&b->servo_silent[s], used && offline, b->config->patience) ? bit : 0u;
        strained |= lasts(&b->servo_strained[s], used && stalled, b->config->patience) ? bit : 0u;
        failed |= used && b->wheel_bad[tendon] >= b->config->bad_samples ? bit : 0u;
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (silent >> s & 1u) {
            trip(b, TDMA_REASON_SERVO_OFFLINE, (uint8_t)(s + 1));
            return;
        }
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        if (strained >> s & 1u) {
            trip(b, TDMA_REASON_SERVO_STALLED, (uint8_t)(s + 1));
            return;
        }
    }
    for (uint8_t c = 0; c < tendons(b) && failed; c++) {
        for (uint8_t s = 0; s < b->config->servos; s++) {
            if ((failed >> s & 1u) && facing(b, s) == c) {
                trip(b, TDMA_REASON_ENCODER_FAULT, (uint8_t)(c + 1));
                return;
            }
        }
    }
    b->looks++;
    if (!b->comparing || b->looks % b->config->compare_every != 0) {
        return;
    }
    for (uint8_t s = 0; s < b->config->servos; s++) {
        uint8_t tendon = facing(b, s);
        if (b->energised[tendon] && !follows(b, s, tendon)) {
            trip(b, TDMA_REASON_WHEEL_STILL, (uint8_t)(tendon + 1));
            return;
        }
    }
}

/* Every 10 ms since the first HELLO: guards, then streams. */
static void tick(struct board *b)
{
    for (uint8_t c = 0; c < tendons(b); c++) {
        bool bad = b->wheel_bits[c] != 0;
        b->wheel_bad[c] = (uint8_t)(!bad ? 0u : b->wheel_bad[c] < 255u ? b->wheel_bad[c] + 1u : 255u);
    }
    if (b->state == TDMA_STATE_ARMED) {
        guard(b);
    }
    send_streams(b);
    b->tick++;
    b->tick_due += BOARD_TICK_MS;
}

/* One thing whose time has come, watchdog first; false if there is none. */
static bool run_due(struct board *b)
{
    if (b->state == TDMA_STATE_ARMED && !host_alive(b)) {
        b->faults |= TDMA_FAULT_WATCHDOG;
        stop(b, TDMA_STATE_SAFE, TDMA_REASON_WATCHDOG, 0);
        return true;
    }
    if (b->job != BOARD_IDLE && reached(b->now, b->job_due)) {
        continue_job(b);
        return true;
    }
    if (b->streaming && reached(b->now, b->tick_due)) {
        tick(b);
        return true;
    }
    return false;
}

void board_step(struct board *board, uint32_t now_ms, const struct board_frame *frame)
{
    board->out_count = 0;
    board->now = now_ms;
    read_wheels(board);
    while (run_due(board)) {
    }
    if (board->moving && now_ms - board->move_fed >= BOARD_SLOT_MS) {
        feed_servos(board);
    }
    if (frame != NULL) {
        receive(board, frame);
    }
}
