/* Starts the test on a Cortex-M4F in QEMU, and counts instructions there: with -icount shift=0 each
 * takes a nanosecond of the emulated clock, whose timer counts at 25 MHz. It counts no cycles. */
#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

extern void _start(void);
unsigned long instructions(void);

static void reset(void)
{
    REGISTER(0xE000ED88) |= 0xFU << 20; /* the floating-point unit is on */
    __asm volatile("dsb\n isb");
    REGISTER(0xE000E014) = 0xFFFFFFU; /* the timer counts down from here */
    REGISTER(0xE000E018) = 0;
    REGISTER(0xE000E010) = 5;
    _start();
}

typedef void (*entry)(void);
__attribute__((section(".vectors"), used)) static const entry vectors[] = {(entry)0x20400000, reset};

unsigned long instructions(void) { return 40UL * (0xFFFFFFUL - REGISTER(0xE000E018)); }
