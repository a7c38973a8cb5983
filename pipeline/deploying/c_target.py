"""The test of a filter on a Cortex-M4F that QEMU emulates (Arm's board MPS2, image AN386)."""

MACHINE = "mps2-an386"
TARGET_OPTIONS = (
    "-std=c99 -O2 -ffp-contract=off -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 "
    "--specs=rdimon.specs -DINSTRUCTIONS=instructions -T cortex_m4f.ld"
)

LINKED = """/* The memory of Arm's MPS2 board, image AN386, for the test. */
MEMORY
{
    CODE (rx) : ORIGIN = 0x00000000, LENGTH = 4M
    RAM (rwx) : ORIGIN = 0x20000000, LENGTH = 4M
}
SECTIONS
{
    .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } > CODE
    .ARM.exidx : { *(.ARM.exidx*) } > CODE
    .init_array : { KEEP(*(.preinit_array*)) KEEP(*(.init_array*)) KEEP(*(.fini_array*)) } > CODE
    .data : { *(.data*) } > RAM
    .bss : { __bss_start__ = .; *(.bss*) *(COMMON) __bss_end__ = .; } > RAM
    end = .;
    __end__ = .;
}
"""

STARTING = """\
/* Starts the test on a Cortex-M4F in QEMU, and counts instructions there: with -icount shift=0 each
 * takes a nanosecond of the emulated clock, whose timer counts at 25 MHz. It counts no cycles. */
#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

extern void _start(void);
unsigned long instructions(void);

static void reset(void)
{
    REGISTER(0xE000ED88) |= 0xFU << 20; /* the floating-point unit is on */
    __asm volatile("dsb\\n isb");
    REGISTER(0xE000E014) = 0xFFFFFFU; /* the timer counts down from here */
    REGISTER(0xE000E018) = 0;
    REGISTER(0xE000E010) = 5;
    _start();
}

typedef void (*entry)(void);
__attribute__((section(".vectors"), used)) static const entry vectors[] = {(entry)0x20400000, reset};

unsigned long instructions(void) { return 40UL * (0xFFFFFFUL - REGISTER(0xE000E018)); }
"""


def target_lines(name: str, *, argument: str) -> list[str]:
    """Write the commands that build a filter's test for the target and run it in QEMU.

    Args:
        name: the filter's name.
        argument: the test's argument, which is the allowed difference from fuselog's own filter.
    """
    return [
        f"arm-none-eabi-gcc {TARGET_OPTIONS} cortex_m4f.c test_{name}.c {name}.c -lm -o test_{name}.elf",
        f"qemu-system-arm -M {MACHINE} -nographic -icount shift=0 -semihosting-config "
        f"enable=on,target=native,arg=test,arg={argument} -kernel test_{name}.elf",
    ]
